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

/// The first point that a search along a direction looks at.
struct Trial {
  double alpha = 0.0;      ///< fraction of the direction; 0 where collisions leave no way
  std::vector<double> to;  ///< the point
  double gain = 0.0;       ///< change of the objective [J]

  /// The change that is decrease enough (Armijo), from the slope along the direction [J].
  double enough(double slope) const;
};

/// The largest collision-free fraction of p, at most the first.
Trial farthest(Walk& walk, const std::vector<double>& p, double first);

/// Whether rounding can fake a change of the objective, where the walk stands.
bool drowns(Walk& walk, double change);

/// Walk along p by the largest collision-free fraction that decreases the objective enough
/// (Armijo), or, where the change drowns in rounding, flattens its slope (approximate Wolfe).
///
/// @param trial  where to begin: what farthest() has found
Search search(Walk& walk, const std::vector<double>& p, Trial trial);

}  // namespace diffcloth::solver
