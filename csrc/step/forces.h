#pragma once

#include <vector>

#include "contact/friction_set.h"
#include "solver/objective.h"
#include "step/problem.h"
#include "step/report.h"

namespace diffcloth::step {

/// Where the stages of a step add the forces that act at its end [N].
struct Forces {
  double* bodies;   ///< of contact, on the bodies' vertices [V, 3]
  double* contact;  ///< of contact, on the cloths' vertices [N, 3]
  double* pins;     ///< that hold the pinned vertices where they are [P, 3]
};

/// Forces that hold pins: the gradient of all that acts on them.
void add_pin_forces(const Problem& problem,
                    const solver::Objective& objective,
                    const std::vector<double>& x,
                    double* pins);

/// What surfaces do to each other, into a report: contacts of each pair, and the force of the first on
/// the second.
class PairTally {
 public:
  PairTally(const Problem& problem, Report& report) : problem_(problem), pairs_(report.pairs) {}

  /// Count the contacts of a solution, and add the forces of barrier and friction there.
  ///
  /// @param contacts  at the solution
  /// @param friction  of the contacts that it was taken from; null where there are none
  void add(const std::vector<contact::Contact>& contacts,
           const contact::FrictionSet* friction,
           const std::vector<double>& x);

  /// Count one contact of two surfaces, the smaller first.
  ///
  /// @param force  of the first on the second [N]
  void add(Index first, Index second, const Vec3& force);

 private:
  PairContacts& of(Index first, Index second);

  const Problem& problem_;
  std::vector<PairContacts>& pairs_;
};

}  // namespace diffcloth::step
