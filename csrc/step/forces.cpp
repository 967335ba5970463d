#include "step/forces.h"

#include <algorithm>
#include <tuple>
#include <utility>

#include "contact/friction_set.h"

namespace diffcloth::step {

using contact::Contact;

void add_pin_forces(const Problem& problem,
                    const solver::Objective& objective,
                    const std::vector<double>& x,
                    double* pins) {
  const std::vector<Index>& pinned = problem.scene.given.pins;
  if (pinned.empty()) return;
  std::vector<double> g;
  objective.gradient(x.data(), g);
  for (std::size_t p = 0; p < pinned.size(); ++p) {
    for (std::size_t k = 0; k < 3; ++k) pins[3 * p + k] += g[3 * pinned[p] + k];
  }
}

PairContacts& PairTally::of(Index first, Index second) {
  const auto key = [](const PairContacts& p) { return std::pair(p.first, p.second); };
  const std::pair pair(first, second);
  auto place = std::ranges::lower_bound(pairs_, pair, {}, key);
  if (place == pairs_.end() || key(*place) != pair) {
    place = pairs_.insert(place, {.first = first, .second = second});
  }
  return *place;
}

void PairTally::add(Index first, Index second, const Vec3& force) {
  PairContacts& pair = of(first, second);
  ++pair.count;
  if (first != second) pair.force += force;
}

void PairTally::add(const std::vector<Contact>& contacts,
                    const contact::FrictionSet* friction,
                    const std::vector<double>& x) {
  if (!problem_.contact) return;
  const contact::ContactModel& model = *problem_.contact;
  const std::vector<Index>& owner = model.mesh().vertex_surface;
  std::vector<double> g(x.size(), 0.0);
  // The force on the second surface is minus the gradient at its vertices, which are then cleared.
  const auto take = [&](PairContacts& pair, Index vertex) {
    Eigen::Map<Vec3> here(g.data() + 3 * vertex);
    if (owner[vertex] == pair.second && pair.first != pair.second) pair.force -= here;
    here.setZero();
  };
  for_each_pair(model, contacts, [&](const auto& key, const auto& of_pair) {
    PairContacts& pair = of(key.first, key.second);
    pair.count += static_cast<Index>(of_pair.size());
    model.add_gradient(of_pair, x.data(), g.data());
    for (const Contact& c : of_pair) {
      for (const Index vertex : c.pair.vertices) take(pair, vertex);
    }
  });
  if (friction == nullptr) return;
  const contact::FrictionSet::Slips& slips = friction->slips(x.data());
  for (std::size_t k = 0; k < slips.size(); ++k) {
    const contact::FrictionSet::Entry& entry = friction->entries()[k];
    const auto [first, second] = surfaces(model, entry.lag);
    PairContacts& pair = of(first, second);
    friction->add_gradient(entry, slips[k], g.data());
    for (const Index vertex : entry.all_points()) take(pair, vertex);
  }
}

}  // namespace diffcloth::step
