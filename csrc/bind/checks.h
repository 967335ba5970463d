#pragma once

#include <cstddef>
#include <vector>

#include "step/inputs.h"
#include "step/scene.h"

namespace diffcloth::bind {

/// Require arrays of matching sizes, and indices in range: the core reads without further checks.
///
/// @throws std::invalid_argument
void check_description(const step::Description& description);

/// Check trees of links, which a description may omit.
void check_mechanisms(const bodies::MechanismsDescription& mechanisms, Index surfaces);

/// Accepted number of values of an input with this extent in one environment of the scene; several if
/// the input may have several forms.
std::vector<std::size_t> accepted_counts(const step::Scene& scene, step::Extent extent);

/// Require that one environment's inputs include all arrays that a step of the scene reads, with
/// accepted sizes.
///
/// @throws std::invalid_argument
void check_inputs(const step::Scene& scene, const step::Inputs& inputs);

}  // namespace diffcloth::bind
