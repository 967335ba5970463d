#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"

namespace diffcloth::elastic::damping {

/// Damping of the stretch of one triangle over a step, weight = k_d k_s A / h:
///
///   E = weight / 8 |C - C_n|^2,   C = F^T F,
///
/// which no rigid motion feels. F_n is F at the start of the step. (The damping of bending is the
/// bending energy about the curvature at the start of the step: see bending.h.)

/// C - C_n without the cancellation of the identity.
inline Mat2 strain(const Mat32& F, const Mat32& F_n) {
  const Mat32 dF = F - F_n;
  return dF.transpose() * F + F_n.transpose() * dF;
}

/// dE/dF = weight / 2 F (C - C_n).
inline Mat32 stress(double weight, const Mat32& F, const Mat32& F_n) {
  return 0.5 * weight * F * strain(F, F_n);
}

/// E(F1) - E(F0), with dF = F1 - F0 computed from differences of positions.
double energy_change(
    double weight, const Mat32& F0, const Mat32& F1, const Mat32& dF, const Mat32& F_n);

/// The Hessian's 3x3 blocks of the lower-triangle pairs, (0,0), (1,0), (1,1), (2,0), (2,1), (2,2):
///
///   H_pq = weight / 2 [ (g_p^T (C - C_n) g_q) I + (F g_q)(F g_p)^T + (g_p.g_q) F F^T ].
///
/// The projected one keeps the positive part of C - C_n.
std::array<Mat3, 6> hessian(
    double weight, const mesh::ShapeGradient& g, const Mat32& F, const Mat32& F_n, bool positive);

/// Change of the stress along a change G of F.
Mat32 stress_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G);

/// Change of the stress along a change G_n of F_n.
Mat32 start_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G_n);

/// Gradient of phi = <stress, G> with respect to F_n, G fixed.
Mat32 start_bar(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G);

}  // namespace diffcloth::elastic::damping
