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

/// C - C_n without the cancellation of the identity.
inline Mat2 strain(const Mat32& F, const Mat32& F_n) {
  const Mat32 dF = F - F_n;
  return dF.transpose() * F + F_n.transpose() * dF;
}

/// dE/dF = weight / 2 F (C - C_n).
inline Mat32 stress(double weight, const Mat32& F, const Mat32& F_n) {
  return 0.5 * weight * F * strain(F, F_n);
}

/// Change of the stress along a change G of F.
Mat32 stress_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G);

/// Change of the stress along a change G_n of F_n.
Mat32 start_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G_n);

/// Gradient of phi = <stress, G> with respect to F_n, G fixed.
Mat32 start_bar(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G);

}  // namespace diffcloth::elastic::damping
