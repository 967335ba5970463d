#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"
#include "mesh/rest_shape.h"

namespace diffcloth::elastic {

// Extrapolation of the second stress T of a triangle, dE/dF = F T, along a straight motion, for any
// energy of its stretch.

/// Second stress after a change G of F, in the linear model of that change.
///
/// @param T   second stress at F
/// @param dP  change of dE/dF along G
Mat2 extrapolated_stress(const Mat32& F, const Mat32& G, const Mat2& T, const Mat32& dP);

/// The change of the Hessian's blocks if its second stress is `extrapolated` instead of T, in the order
/// of stretch_lanes.h:
///
///   (g_p^T dT g_q) I,
///
/// and for the projected one, where the positive part of the second stress is T+ + dT+,
/// (g_p^T dT+ g_q) n n^T, which leaves it positive semi-definite.
std::array<Mat3, 6> extrapolation(const mesh::ShapeGradient& g,
                                  const Mat32& F,
                                  const Mat2& T,
                                  const Mat2& extrapolated,
                                  bool positive);

}  // namespace diffcloth::elastic
