#include "solver/line_search.h"

#include <algorithm>
#include <cmath>

namespace diffcloth::solver {
namespace {

/// Sufficient decrease, and the slope that replaces it where the change drowns in rounding.
constexpr double kArmijo = 1e-4;
constexpr double kWolfeSlope = 0.8;
/// Relative size of a change of energy that rounding can fake.
constexpr double kEnergyNoise = 1e-11;
/// Halvings of the step: beyond, it is lost in the rounding of the coordinates.
constexpr int kBacktracks = 40;

}  // namespace

Search search(Walk& walk, const std::vector<double>& p, double first) {
  Search result;
  std::vector<double> to;
  double alpha =
      walk.watch(p, std::min(first, walk.f.coordinates->largest_fraction(walk.x(), p)), to);
  if (!(alpha > 0.0)) {
    result.result = SearchResult::kBlocked;
    return result;
  }
  const double slope = dot(walk.g(), p);
  const std::vector<double> start = walk.x();
  double noise = -1.0;  // not needed before a trial fails

  for (; result.backtracks < kBacktracks; ++result.backtracks, alpha *= 0.5) {
    if (result.backtracks > 0) {
      if (walk.f.coordinates->is_curved()) {
        alpha = walk.watch(p, alpha, to);
        if (!(alpha > 0.0)) break;
      } else {
        walk.f.coordinates->retract(start, p, alpha, to);
      }
    }
    walk.context.checkpoint->check();
    const double gain = walk.change(to);
    const bool decreased = gain <= kArmijo * alpha * slope;
    if (!decreased) {
      if (noise < 0.0) noise = kEnergyNoise * std::abs(walk.f.energy(start.data()));
      if (!(std::abs(gain) <= noise)) continue;
    }
    if (decreased) {
      walk.go(to);
      walk.refresh();
    } else if (!walk.go_if_flat(to, p, kWolfeSlope * std::abs(slope))) {
      continue;
    }
    result.result = SearchResult::kMoved;
    result.alpha = alpha;
    result.gain = gain;
    result.measured = decreased;
    return result;
  }
  return result;
}

}  // namespace diffcloth::solver
