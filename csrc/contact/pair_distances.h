#pragma once

#include <cstddef>
#include <vector>

#include "contact/broad_phase.h"

namespace diffcloth::contact {

/// Index of the first edge-edge pair among sorted pairs.
std::ptrdiff_t first_of_edges(const std::vector<Candidate>& pairs);

/// Squared distances of sorted pairs at x, many at once [m^2].
std::vector<double> distances_sq(const std::vector<Candidate>& pairs, const double* x);

}  // namespace diffcloth::contact
