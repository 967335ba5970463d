#pragma once

#include "common/types.h"
#include "elastic/frame.h"

namespace diffcloth::elastic::stretch {

/// Stretch energy of one triangle, weight = k_s A:
///
///   E = k_s A / 2 |F - R|^2 = k_s A / 2 (tr C - 2 t + 2),   R the closest orthonormal columns.
///
/// All functions take the deformation gradient F; forces on corner p are (dE/dF) g_p. The functions that
/// a solve calls repeatedly are in stretch_lanes.h.

/// dE/dF = k_s A (F - R).
inline Mat32 stress(double weight, const Mat32& F) {
  return weight * (F - frame(F).R.leftCols<2>());
}

double energy(double weight, const Mat32& F);

/// The second stress T, symmetric, in the plane of the rest shape: dE/dF = F T, T = k_s A (I - S^-1).
Mat2 second_stress(double weight, const Mat32& F);

/// Change of the stress along a change G of F: k_s A (G - dR[G]).
Mat32 stress_change(double weight, const Mat32& F, const Mat32& G);

}  // namespace diffcloth::elastic::stretch
