#pragma once

#include "common/types.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic::orthotropic_damping {

/// Damping of the stretch of one woven triangle over a step, with one stiffness for each direction:
///
///   E = k_d A / (8 h) <K o D, D>,   D = C - C_n in material axes,
///
/// which equals the damping of damping.h if the three are equal. All functions take a weave times k_d A
/// / h,
/// and deformation gradients in the rest frame; W(D) = weave.times_in_rest_frame(D).

/// dE/dF = 1/2 F W(C - C_n).
Mat32 stress(const Weave& weave, const Mat32& F, const Mat32& F_n);

/// Change of the stress along a change G of F.
Mat32 stress_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G);

/// Change of the stress along a change G_n of F_n.
Mat32 start_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G_n);

/// Gradient of phi = <stress, G> with respect to F_n, G fixed.
Mat32 start_bar(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G);

}  // namespace diffcloth::elastic::orthotropic_damping
