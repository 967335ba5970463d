#pragma once

#include <string>
#include <vector>

#include "bind/arrays.h"
#include "step/report.h"

namespace diffcloth::bind {

/// Names of the numbers of a report, seconds of the phases included.
std::vector<std::string> number_names();

/// Numbers of all environments' reports, one list for each number: cheaper than arrays of one number.
nb::list to_lists(const std::vector<step::Report>& reports);

/// Environments whose prescribed motion ended early -> poses of all roots there [T, 7].
nb::dict ended_poses(const std::vector<step::Report>& reports);

/// For each environment the pairs of surfaces in contact: (first, second, count, force of the first on
/// the second).
nb::list pair_contacts(const std::vector<step::Report>& reports);

/// For each environment the contacts [M, 16]: both surfaces, the points on them, the normal from the
/// first to the second, the gap, and the normal and the tangential force of the first on the second.
nb::list contact_points(const std::vector<step::Report>& reports);

}  // namespace diffcloth::bind
