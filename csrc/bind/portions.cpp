#include "bind/portions.h"

#include <utility>

#include "step/step.h"

namespace diffcloth::bind {

std::vector<Portion> make_portions(std::size_t environments,
                                   std::size_t count,
                                   const std::function<bool(std::size_t row)>& is_zero) {
  std::vector<Portion> portions;
  for (std::size_t e = 0; e < environments; ++e) {
    std::vector<std::size_t> rows;
    for (std::size_t row = e; row < count * environments; row += environments) {
      if (!is_zero(row)) rows.push_back(row);
      if (rows.size() < step::kAtOnce) continue;
      portions.push_back({.environment = e, .rows = std::move(rows)});
      rows.clear();
    }
    if (!rows.empty()) portions.push_back({.environment = e, .rows = std::move(rows)});
  }
  return portions;
}

std::vector<double> expected_costs(const std::vector<Portion>& portions,
                                   const std::vector<double>& of_environments) {
  // The shared work of a portion, contacts and the factor, costs about as much as three rows.
  constexpr double kShared = 3.0;
  std::vector<double> costs;
  costs.reserve(portions.size());
  for (const auto& [environment, rows] : portions) {
    costs.push_back((kShared + static_cast<double>(rows.size())) * of_environments[environment]);
  }
  return costs;
}

}  // namespace diffcloth::bind
