#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"

namespace diffcloth::elastic::stretch {

/// Stretch energy of one triangle, weight = k_s A:
///
///   E = k_s A / 2 |F - R|^2 = k_s A / 2 (tr C - 2 t + 2),   R the closest orthonormal columns.
///
/// All functions take the deformation gradient F; forces on corner p are (dE/dF) g_p.

/// dE/dF = k_s A (F - R).
inline Mat32 stress(double weight, const Mat32& F) {
  return weight * (F - frame(F).R.leftCols<2>());
}

double energy(double weight, const Mat32& F);

/// E(F1) - E(F0), with dF = F1 - F0 computed from differences of positions. With both frames
/// orthonormal,
///
///   dE = k_s A / 2 ( <F0 - R0 + F1 - R1, dF> - 1/2 <S1 - S0, dR^T dR> ).
double energy_change(double weight, const Mat32& F0, const Mat32& F1, const Mat32& dF);

/// The Hessian's 3x3 blocks of the lower-triangle pairs (0,0), (1,0), (1,1), (2,0), (2,1), (2,2):
///
///   H_pq = k_s A [ (g_p.g_q) I - (1/t) e_p e_q^T - (g_p^T S^-1 g_q) n n^T ],
///   e_p = g_p0 r2 - g_p1 r1.
///
/// The projected one clamps 1/t to 1/2 and the eigenvalues of S^-1 to 1.
std::array<Mat3, 6> hessian(double weight,
                            const mesh::ShapeGradient& g,
                            const Mat32& F,
                            bool positive);

/// The second stress T, symmetric, in the plane of the rest shape: dE/dF = F T, T = k_s A (I - S^-1).
Mat2 second_stress(double weight, const Mat32& F);

/// Second stress after a change G of F, in the linear model of that change.
Mat2 extrapolated_stress(double weight, const Mat32& F, const Mat32& G);

/// The change of hessian() where its second stress is T + dT, in the same order:
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
