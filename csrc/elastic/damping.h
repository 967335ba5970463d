#pragma once

#include "common/types.h"
#include "elastic/frame.h"

namespace diffcloth::elastic::damping {

/// Damping of the stretch of one triangle over a step, weight = k_d k_s A / h:
///
///   E = weight / 8 |C - C_n|^2,   C = F^T F,
///
///   H_pq = weight / 2 [ (g_p^T (C - C_n) g_q) I + (F g_q)(F g_p)^T + (g_p.g_q) F F^T ],
///
/// which is invariant under rigid motion. F_n is F at the start of the step. Energies, gradients and
/// Hessians of many triangles are in stretch_lanes.h. (The damping of bending is the bending energy
/// about the curvature at the start of the step: see bending.h.)
///
/// A step of second order has a prediction of its end, with the gradient F_a, and evaluates elasticity
/// at the end minus the predicted displacement, near the start. C_n above is then
///
///   C_n - kAhead (C_a - C_n),   kAhead = 2,
///
/// so that E, with half the weight, resists the mean of the predicted rate (C_a - C_n) / h and the rate
/// of the step.

/// Multiple of the predicted change of C in the strain of damping.
inline constexpr double kAhead = 2.0;

/// Deformation gradients from which damping counts.
struct Start {
  Mat32 F_n;
  Mat32 F_a;
  double ahead;  ///< kAhead with a prediction, else 0
};

/// C - C_n without the cancellation of the identity.
inline Mat2 strain(const Mat32& F, const Mat32& F_n) {
  const Mat32 dF = F - F_n;
  return dF.transpose() * F + F_n.transpose() * dF;
}

/// Likewise, with a prediction.
inline Mat2 strain(const Mat32& F, const Start& start) {
  Mat2 result = strain(F, start.F_n);
  if (start.ahead != 0.0) result += start.ahead * strain(start.F_a, start.F_n);
  return result;
}

/// Change of the strain along changes of F_n and F_a.
Mat2 start_change(const Start& start, const Start& change);

/// Gradients of <strain, bar> with respect to F_n and F_a.
Start start_bar(const Start& start, const Mat2& bar);

/// dE/dF = weight / 2 F (C - C_n).
inline Mat32 stress(double weight, const Mat32& F, const Start& start) {
  return 0.5 * weight * F * strain(F, start);
}

/// Change of the stress along a change G of F.
Mat32 stress_change(double weight, const Mat32& F, const Start& start, const Mat32& G);

/// Change of the stress along a change of the start.
inline Mat32 stress_change(double weight, const Mat32& F, const Start& start, const Start& change) {
  return 0.5 * weight * F * start_change(start, change);
}

/// Gradients of phi = <stress, G> with respect to F_n and F_a, G fixed.
Start start_bar(double weight, const Mat32& F, const Start& start, const Mat32& G);

}  // namespace diffcloth::elastic::damping
