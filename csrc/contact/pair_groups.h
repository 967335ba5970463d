#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "contact/contact_set.h"

namespace diffcloth::contact {

/// Surfaces of a contact, the smaller first.
inline std::pair<Index, Index> surfaces(const ContactModel& model, const Contact& contact) {
  const auto& owner = model.mesh().vertex_surface;
  return std::minmax(owner[contact.pair.vertices[0]], owner[contact.pair.vertices[3]]);
}

/// Call visit(pair, its contacts) for every pair of surfaces; contacts of a pair keep their order.
template <class Visit>
void for_each_pair(const ContactModel& model, const std::vector<Contact>& contacts, Visit&& visit) {
  const auto of = [&](const Contact& c) { return surfaces(model, c); };
  if (contacts.empty()) return;
  const auto pair = of(contacts.front());
  if (std::ranges::all_of(contacts, [&](const auto& c) { return of(c) == pair; })) {
    visit(pair, contacts);
    return;
  }
  std::vector<Contact> sorted = contacts;
  std::ranges::stable_sort(sorted, {}, of);
  for (auto first = sorted.begin(); first != sorted.end();) {
    const auto here = of(*first);
    const auto last =
        std::find_if(first, sorted.end(), [&](const auto& c) { return of(c) != here; });
    visit(here, std::vector<Contact>(first, last));
    first = last;
  }
}

}  // namespace diffcloth::contact
