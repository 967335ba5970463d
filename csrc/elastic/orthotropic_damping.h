#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"
#include "elastic/weave.h"
#include "mesh/rest_shape.h"

namespace diffcloth::elastic::orthotropic_damping {

/// Damping of the stretch of one woven triangle over a step, each direction by its own stiffness:
///
///   E = k_d A / (8 h) <K o D, D>,   D = C - C_n in material axes,
///
/// which is that of damping.h where the three are equal. All functions take a weave times k_d A / h,
/// and deformation gradients in the rest frame; W(D) = weave.times_in_rest_frame(D).

/// dE/dF = 1/2 F W(C - C_n).
Mat32 stress(const Weave& weave, const Mat32& F, const Mat32& F_n);

/// E(F1) - E(F0), with dF = F1 - F0 computed from differences of positions.
double energy_change(
    const Weave& weave, const Mat32& F0, const Mat32& F1, const Mat32& dF, const Mat32& F_n);

/// The Hessian's 3x3 blocks of the lower-triangle pairs, (0,0), (1,0), (1,1), (2,0), (2,1), (2,2):
///
///   H_pq = 1/2 [ (g_p^T W(C - C_n) g_q) I + F M_pq F^T ],   M_pq a = W(a g_q^T + g_q a^T) g_p.
///
/// The projected one keeps the positive part of W(C - C_n).
std::array<Mat3, 6> hessian(const Weave& weave,
                            const mesh::ShapeGradient& g,
                            const Mat32& F,
                            const Mat32& F_n,
                            bool positive);

/// Change of the stress along a change G of F.
Mat32 stress_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G);

/// Change of the stress along a change G_n of F_n.
Mat32 start_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G_n);

/// Gradient of phi = <stress, G> with respect to F_n, G fixed.
Mat32 start_bar(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G);

}  // namespace diffcloth::elastic::orthotropic_damping
