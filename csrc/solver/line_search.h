#pragma once

#include <cstdint>
#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

enum class SearchResult : std::uint8_t {
  kMoved,
  kBlocked,  ///< collision detection leaves no way to go
  kNoGain,   ///< no point along the way is lower, as far as rounding can tell
};

struct Search {
  SearchResult result = SearchResult::kNoGain;
  double alpha = 0.0;  ///< fraction of the direction that was walked
  double gain = 0.0;   ///< change of the objective [J]
  int backtracks = 0;
  bool measured = true;  ///< the decrease was larger than what rounding can fake
};

/// Walk along p by the largest collision-free fraction that decreases the objective enough
/// (Armijo), or, where the change drowns in rounding, flattens its slope (approximate Wolfe).
///
/// @param first  fraction that is tried first, >= 1 to go beyond the full step
Search search(Walk& walk, const std::vector<double>& p, double first);

}  // namespace diffcloth::solver
