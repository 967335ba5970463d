#pragma once

#include "elastic/elastic.h"
#include "elastic/weave.h"

namespace diffcloth::elastic {

/// Call visit with a unit weave for each of the stiffnesses, and with its cotangent.
template <class Visit>
void for_each_stiffness(const Weave& k, Index f, Bar& bar, const Visit& visit) {
  visit(Weave{.warp = 1.0, .weft = 0.0, .shear = 0.0, .axis = k.axis}, bar.stretch[f]);
  visit(Weave{.warp = 0.0, .weft = 1.0, .shear = 0.0, .axis = k.axis}, bar.stretch_weft[f]);
  visit(Weave{.warp = 0.0, .weft = 0.0, .shear = 1.0, .axis = k.axis}, bar.stretch_shear[f]);
}

// The parts of add_mixed(), add_tangent() and add_energy_bars() for one face whose stretch has three
// stiffnesses, even if their values are equal.

void add_woven_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar);

/// The part of damping; the model has a start of the step.
void add_woven_damping_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar);

void add_woven_tangent(const Model& model,
                       Index f,
                       const double* x,
                       const Bar& dot,
                       const Changing& changing,
                       double* y);

void add_woven_energy_bars(const Model& model,
                           Index f,
                           const double* x,
                           double seed,
                           bool with_rest,
                           Bar& bar,
                           double* x_bar);

}  // namespace diffcloth::elastic
