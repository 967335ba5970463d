#pragma once

#include <vector>

#include "contact/friction_set.h"
#include "step/problem.h"
#include "step/report.h"

namespace diffcloth::step {

/// Where surfaces touch at the end of a step, and with which forces: one for each pair of features that the
/// barrier keeps apart there, in their order.
///
/// Friction of a pair goes to its contact; friction of pairs that are no longer in contact, as it comes from
/// the contacts of the last but one solution, has points of its own, without a normal force.
///
/// @param contacts  at the solution
/// @param friction  null where there is none
std::vector<ContactPoint> contact_points(const Problem& problem,
                                         const std::vector<contact::Contact>& contacts,
                                         const contact::FrictionSet* friction,
                                         const std::vector<double>& x);

}  // namespace diffcloth::step
