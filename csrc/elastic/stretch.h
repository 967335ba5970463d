#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"
#include "mesh/rest_shape.h"

namespace diffcloth::elastic::stretch {

/// Stretch energy of one triangle, weight = k_s A:
///
///   E = k_s A / 2 |F - R|^2 = k_s A / 2 (tr C - 2 t + 2),   R the closest orthonormal columns.
///
/// All functions take the deformation gradient F; forces on corner p are (dE/dF) g_p. What a solve
/// asks for again and again is in stretch_lanes.h.

/// dE/dF = k_s A (F - R).
inline Mat32 stress(double weight, const Mat32& F) {
  return weight * (F - frame(F).R.leftCols<2>());
}

double energy(double weight, const Mat32& F);

/// The second stress T, symmetric, in the plane of the rest shape: dE/dF = F T, T = k_s A (I - S^-1).
Mat2 second_stress(double weight, const Mat32& F);

/// Second stress after a change G of F, in the linear model of that change.
Mat2 extrapolated_stress(double weight, const Mat32& F, const Mat32& G);

/// The change of the Hessian's blocks where its second stress is T + dT, in the order of
/// stretch_lanes.h:
///
///   (g_p^T dT g_q) I,
///
/// and for the projected one, where the positive part of the second stress is T+ + dT+,
/// (g_p^T dT+ g_q) n n^T, which leaves it positive semi-definite.
std::array<Mat3, 6> extrapolation(double weight,
                                  const mesh::ShapeGradient& g,
                                  const Mat32& F,
                                  const Mat2& extrapolated,
                                  bool positive);

/// Change of the stress along a change G of F: k_s A (G - dR[G]).
Mat32 stress_change(double weight, const Mat32& F, const Mat32& G);

}  // namespace diffcloth::elastic::stretch
