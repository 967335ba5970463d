#pragma once

#include "elastic/damping.h"
#include "elastic/elastic.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic {

// Stretch and damping of one face of a model, isotropic or orthotropic, by its deformation gradient F;
// damping has a start. See stretch.h, damping.h and orthotropic_*.h.

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

/// Start of the damping of a face; the model has a start of the step.
damping::Start damping_start(const Model& model, Index f);

/// Tangent of damping_start().
damping::Start damping_start_change(const Model& model,
                                    Index f,
                                    const Bar& dot,
                                    const Changing& changing);

/// Pull a cotangent of damping_start() back to the positions and, if `with_rest`, to the rest shape.
void add_damping_start(
    const Model& model, Index f, const damping::Start& start_bar, bool with_rest, Bar& bar);

Mat32 damping_stress_change(
    const Model& model, Index f, const Mat32& F, const damping::Start& start, const Mat32& G);

}  // namespace diffcloth::elastic
