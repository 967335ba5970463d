#pragma once

#include "common/types.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic::orthotropic {

/// Stretch energy of one woven triangle. With w and f the columns of F along the yarns, R = [r_w, r_f] the
/// polar factor and t = tr S,
///
///   E = A [ k_w / 2 (|w| - 1)^2 + k_f / 2 (|f| - 1)^2 + k_wf (|w| + |f| - t) ].
///
/// The yarns are springs, each along itself. The last term is k_wf times |w| (1 - cos) + |f| (1 - cos),
/// with the angles that turn the yarns from r_w and r_f: it is at least 0, and 0 if the yarns are at
/// right angles, independent of their lengths. So shear never lengthens a yarn at the price of k_wf
/// alone, and a tension T along a yarn strains it by T / k and stiffens its shear. To second order in
/// small strain the term is k_wf e_wf^2.
///
/// It is the isotropic energy of stretch.h with k_wf, plus springs of the stiffnesses k_w - k_wf and k_f
/// - k_wf, of either sign, along the yarns:
///
///   dE/dF = A [ k_wf (F - R) + (k_y - k_wf) (1 - 1 / |y|) y ],   y = w in its column, y = f in its own.
///
/// Without cancellation |w| + |f| - t = 2 (w.f)^2 / ((|w| |f| + d) (|w| + |f| + t)), d = |w x f|.
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
