#pragma once

#include <cstddef>
#include <vector>

#include "step/inputs.h"
#include "step/scene.h"

namespace diffcloth::bind {

/// Require arrays that fit each other, and indices in range: the core reads by them without asking.
///
/// @throws std::invalid_argument
void check_description(const step::Description& description);

/// Likewise trees of links, which a description may leave out.
void check_mechanisms(const bodies::MechanismsDescription& mechanisms, Index surfaces);

/// Numbers that one environment may have of an input of this extent in this scene; several counts where
/// it may be given in several ways.
std::vector<std::size_t> accepted_counts(const step::Scene& scene, step::Extent extent);

/// Require that one environment's inputs have all that a step of the scene reads, of accepted counts.
///
/// @throws std::invalid_argument
void check_inputs(const step::Scene& scene, const step::Inputs& inputs);

}  // namespace diffcloth::bind
