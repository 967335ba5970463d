#pragma once

#include "common/types.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic::orthotropic {

/// Stretch energy of one woven triangle. With S = sqrt(F^T F) in material axes and e = S - I,
///
///   E = A / 2 (k_w e_ww^2 + k_f e_ff^2 + 2 k_wf e_wf^2),
///
/// which is that of stretch.h where the three are equal. With T = A K o e, t = tr S, R the polar
/// factor of F and J the rotation by 90 degrees,
///
///   dE/dF = R B,   B = T + (omega / t) J,   omega J = S T - T S,
///
/// because dS solves S dS + dS S = dC. Nothing is divided by the area ratio, so degenerate
/// triangles stay finite. The second stress is S^-1 B, symmetric.
///
/// Changes of energy, gradients and Hessians of many triangles are in stretch_lanes.h. All functions here
/// take a weave times the area of the triangle, and F in its rest frame. Stresses are linear in the weave.

double energy(const Weave& weave, const Mat32& F);

/// dE/dF.
Mat32 stress(const Weave& weave, const Mat32& F);

/// The second stress T2, symmetric, in the rest frame: dE/dF = F T2.
Mat2 second_stress(const Weave& weave, const Mat32& F);

/// Change of the stress along a change G of F.
Mat32 stress_change(const Weave& weave, const Mat32& F, const Mat32& G);

}  // namespace diffcloth::elastic::orthotropic
