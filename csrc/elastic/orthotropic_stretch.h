#pragma once

#include <array>

#include "common/types.h"
#include "elastic/frame.h"
#include "elastic/weave.h"
#include "mesh/rest_shape.h"

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
/// All functions take a weave times the area of the triangle, and F and shape gradients in its rest
/// frame. Stresses are linear in the weave.

double energy(const Weave& weave, const Mat32& F);

/// E(F1) - E(F0), with dF = F1 - F0 from differences of positions. No digits cancel: with M = S0 + S1,
///
///   M dS + dS M = 2 (C1 - C0),   dE = A / 2 <K o (e0 + e1), dS>.
double energy_change(const Weave& weave, const Mat32& F0, const Mat32& F1, const Mat32& dF);

/// dE/dF.
Mat32 stress(const Weave& weave, const Mat32& F);

/// The second stress T2, symmetric, in the rest frame: dE/dF = F T2.
Mat2 second_stress(const Weave& weave, const Mat32& F);

/// Change of the stress along a change G of F.
Mat32 stress_change(const Weave& weave, const Mat32& F, const Mat32& G);

/// The Hessian's 3x3 blocks of the lower-triangle pairs, (0,0), (1,0), (1,1), (2,0), (2,1), (2,2). In
/// the frame of R it is, out of plane, the second stress, and in plane a form of four numbers; the
/// projected one clamps the eigenvalues of both at zero.
std::array<Mat3, 6> hessian(const Weave& weave,
                            const mesh::ShapeGradient& g,
                            const Mat32& F,
                            bool positive);

}  // namespace diffcloth::elastic::orthotropic
