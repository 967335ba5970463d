#include "contact/surface_pairs.h"

namespace diffcloth::contact {

SurfacePairs touching_surfaces(const TouchRules& rules) {
  const auto is_dynamic = [&](Index surface) {
    return !rules.body_dynamic.empty() && rules.body_dynamic[surface - rules.cloth_count] != 0;
  };
  SurfacePairs pairs(rules.surface_count);
  for (Index a = 0; a < rules.surface_count; ++a) {
    for (Index b = a; b < rules.surface_count; ++b) {
      if (a < rules.cloth_count) {
        pairs.set(a, b, a != b || rules.self_contact);
      } else {
        pairs.set(a, b, a != b && (is_dynamic(a) || is_dynamic(b)));
      }
    }
  }
  for (const auto& [a, b] : rules.ignored) pairs.set(a, b, false);
  return pairs;
}

}  // namespace diffcloth::contact
