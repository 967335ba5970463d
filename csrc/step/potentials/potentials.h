#pragma once

#include <memory>
#include <vector>

#include "step/step_potential.h"

namespace diffcloth::step {

/// Every potential of the cloths but inertia and contact, in the order of all sums.
///
/// @param problem  whose inputs, masses, rest shape, start and model are there
/// @param wanted   whose cotangents are wanted; null: nobody's
std::vector<std::unique_ptr<StepPotential>> make_potentials(const Problem& problem,
                                                            const Gradients* wanted);

}  // namespace diffcloth::step
