#pragma once

#include <cstddef>
#include <functional>
#include <vector>

namespace diffcloth::bind {

/// Losses or directions of an environment that the core processes together.
struct Portion {
  std::size_t environment;
  std::vector<std::size_t> rows;  ///< loss or direction * environments + environment
};

/// Expected cost of each portion, from the cost of one row in each environment, in any unit.
std::vector<double> expected_costs(const std::vector<Portion>& portions,
                                   const std::vector<double>& of_environments);

/// Partition all nonzero rows, environment by environment.
std::vector<Portion> make_portions(std::size_t environments,
                                   std::size_t count,
                                   const std::function<bool(std::size_t row)>& is_zero);

}  // namespace diffcloth::bind
