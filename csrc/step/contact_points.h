#pragma once

#include <vector>

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
/// @param lagged    those that friction was taken from
std::vector<ContactPoint> contact_points(const Problem& problem,
                                         const std::vector<contact::Contact>& contacts,
                                         const std::vector<contact::Contact>& lagged,
                                         const std::vector<double>& x);

}  // namespace diffcloth::step
