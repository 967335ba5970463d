#pragma once

#include <cstdint>
#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

enum class SearchResult : std::uint8_t {
  kMoved,
  kBlocked,  ///< collision detection leaves no part of the direction
  kNoGain,   ///< no point along the direction is lower, as far as rounding allows to measure
};

struct Search {
  SearchResult result = SearchResult::kNoGain;
  double alpha = 0.0;  ///< fraction of the direction that was accepted
  double gain = 0.0;   ///< change of the objective [J]
  int backtracks = 0;
  bool measured = true;  ///< the decrease exceeded the noise of rounding
};

/// First trial point of a search along a direction.
struct Trial {
  double alpha = 0.0;      ///< fraction of the direction; 0 if collisions leave no part of it
  std::vector<double> to;  ///< the point
  double gain = 0.0;       ///< change of the objective [J]

  /// Change of the objective that is a sufficient decrease (Armijo), for a slope along the direction
  /// [J].
  double enough(double slope) const;
};

/// Trial point at the largest collision-free fraction of p, at most `first`.
Trial farthest(Walk& walk, const std::vector<double>& p, double first);

/// True if rounding may account for a change of the objective at the current iterate.
bool drowns(Walk& walk, double change);

/// Backtracking line search along p: accept the largest collision-free fraction that decreases the
/// objective sufficiently (Armijo) or, if the change drowns in rounding, flattens its slope (approximate
/// Wolfe).
///
/// @param trial  first trial point, from farthest()
Search search(Walk& walk, const std::vector<double>& p, Trial trial);

}  // namespace diffcloth::solver
