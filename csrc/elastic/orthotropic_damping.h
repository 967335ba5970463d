#pragma once

#include "common/types.h"
#include "elastic/damping.h"
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
Mat32 stress(const Weave& weave, const Mat32& F, const damping::Start& start);

/// Change of the stress along a change G of F.
Mat32 stress_change(const Weave& weave,
                    const Mat32& F,
                    const damping::Start& start,
                    const Mat32& G);

/// Change of the stress along a change of the start.
Mat32 stress_change(const Weave& weave,
                    const Mat32& F,
                    const damping::Start& start,
                    const damping::Start& change);

/// Gradients of phi = <stress, G> with respect to F_n and F_a, G fixed.
damping::Start start_bar(const Weave& weave,
                         const Mat32& F,
                         const damping::Start& start,
                         const Mat32& G);

}  // namespace diffcloth::elastic::orthotropic_damping
