#pragma once

#include "elastic/elastic.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic {

// Stretch and damping of one face of a model, isotropic or orthotropic, by its deformation gradient F;
// F_n is the gradient at the start of the step. See stretch.h, damping.h and orthotropic_*.h.

double stretch_energy(const Model& model, Index f, const Mat32& F);

/// T with dE/dF = F T.
Mat2 second_stress(const Model& model, Index f, const Mat32& F);

/// Change of dE/dF along a change G of F.
Mat32 stretch_stress_change(const Model& model, Index f, const Mat32& F, const Mat32& G);

/// The stiffnesses of a face, times its area; an isotropic face has three equal ones, along its rest
/// frame.
Weave stretch_weave(const Model& model, Index f);

/// Likewise for its damping.
Weave damping_weave(const Model& model, Index f);

Mat32 damping_stress_change(
    const Model& model, Index f, const Mat32& F, const Mat32& F_n, const Mat32& G);

}  // namespace diffcloth::elastic
