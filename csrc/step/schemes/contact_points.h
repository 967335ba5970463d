#pragma once

#include <vector>

#include "contact/friction_set.h"
#include "step/problem.h"
#include "step/report.h"

namespace diffcloth::step {

/// Contact points and forces at the end of a step: one for each pair of features that the barrier keeps
/// apart there, in the order of the pairs.
///
/// Friction of a pair is added to its contact. Friction comes from the contacts of the previous solve;
/// friction of pairs that are no longer in contact has points of its own, without a normal force.
///
/// @param contacts  at the solution
/// @param friction  null if there is none
std::vector<ContactPoint> contact_points(const Problem& problem,
                                         const std::vector<contact::Contact>& contacts,
                                         const contact::FrictionSet* friction,
                                         const std::vector<double>& x);

}  // namespace diffcloth::step
