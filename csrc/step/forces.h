#pragma once

#include <algorithm>
#include <utility>
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

/// Surfaces of a contact, the smaller first.
inline std::pair<Index, Index> surfaces(const contact::ContactModel& model,
                                        const contact::Contact& contact) {
  const auto& owner = model.mesh().vertex_surface;
  return std::minmax(owner[contact.pair.vertices[0]], owner[contact.pair.vertices[3]]);
}

/// Call visit(pair, contacts of it) for every pair of surfaces, in the order of the contacts.
template <class Visit>
void for_each_pair(const contact::ContactModel& model,
                   const std::vector<contact::Contact>& contacts,
                   Visit&& visit) {
  const auto of = [&](const contact::Contact& c) { return surfaces(model, c); };
  if (contacts.empty()) return;
  const auto pair = of(contacts.front());
  if (std::ranges::all_of(contacts, [&](const auto& c) { return of(c) == pair; })) {
    visit(pair, contacts);
    return;
  }
  std::vector<contact::Contact> sorted = contacts;
  std::ranges::stable_sort(sorted, {}, of);
  for (auto first = sorted.begin(); first != sorted.end();) {
    const auto here = of(*first);
    const auto last =
        std::find_if(first, sorted.end(), [&](const auto& c) { return of(c) != here; });
    visit(here, std::vector<contact::Contact>(first, last));
    first = last;
  }
}

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
