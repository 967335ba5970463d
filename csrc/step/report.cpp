#include "step/report.h"

#include <algorithm>
#include <utility>

#include "contact/pair_groups.h"

namespace diffcloth::step {

using contact::Contact;

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

void PairTally::add(const contact::ContactModel& model,
                    const std::vector<Contact>& contacts,
                    const contact::FrictionSet* friction,
                    const std::vector<double>& x) {
  const std::vector<Index>& owner = model.mesh().vertex_surface;
  std::vector<double> g(x.size(), 0.0);
  // The force on the second surface is minus the gradient at its vertices, which are then cleared.
  const auto take = [&](PairContacts& pair, Index vertex) {
    Eigen::Map<Vec3> here(g.data() + 3 * vertex);
    if (owner[vertex] == pair.second && pair.first != pair.second) pair.force -= here;
    here.setZero();
  };
  contact::for_each_pair(model, contacts, [&](const auto& key, const auto& of_pair) {
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
    const auto [first, second] = contact::surfaces(model, entry.lag);
    PairContacts& pair = of(first, second);
    friction->add_gradient(entry, slips[k], g.data());
    for (const Index vertex : entry.all_points()) take(pair, vertex);
  }
}

}  // namespace diffcloth::step
