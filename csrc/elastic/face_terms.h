#pragma once

#include <array>

#include "elastic/elastic.h"
#include "elastic/frame.h"

namespace diffcloth::elastic {

// Stretch and damping of one face of a model, isotropic or orthotropic, by its deformation gradient F;
// F_n is that at the start of the step. See stretch.h, damping.h and orthotropic_*.h.

double stretch_energy(const Model& model, Index f, const Mat32& F);

/// dE/dF.
Mat32 stretch_stress(const Model& model, Index f, const Mat32& F);

/// T with dE/dF = F T.
Mat2 second_stress(const Model& model, Index f, const Mat32& F);

/// Change of dE/dF along a change G of F.
Mat32 stretch_stress_change(const Model& model, Index f, const Mat32& F, const Mat32& G);

double damping_energy_change(const Model& model,
                             Index f,
                             const Mat32& F0,
                             const Mat32& F1,
                             const Mat32& dF,
                             const Mat32& F_n);

Mat32 damping_stress(const Model& model, Index f, const Mat32& F, const Mat32& F_n);

Mat32 damping_stress_change(
    const Model& model, Index f, const Mat32& F, const Mat32& F_n, const Mat32& G);

/// Blocks as in stretch_lanes.h.
std::array<Mat3, 6> damping_hessian(
    const Model& model, Index f, const Mat32& F, const Mat32& F_n, bool positive);

}  // namespace diffcloth::elastic
