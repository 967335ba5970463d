#include "solver/line_search.h"

#include <algorithm>
#include <cmath>

#include "solver/stopping.h"

namespace diffcloth::solver {

using stopping::kLineSearch;

double Trial::enough(double slope) const { return kLineSearch.armijo * alpha * slope; }

Trial farthest(Walk& walk, const std::vector<double>& p, double first) {
  Trial trial;
  trial.alpha = walk.watch(p, std::min(first, walk.f.largest_fraction(walk.x(), p)), trial.to);
  if (trial.alpha > 0.0) trial.gain = walk.change(trial.to);
  return trial;
}

bool drowns(Walk& walk, double change) {
  if (std::abs(change) > kLineSearch.energy_noise * kLineSearch.clearly * walk.extent())
    return false;
  return std::abs(change) <= kLineSearch.energy_noise * std::abs(walk.energy());
}

Search search(Walk& walk, const std::vector<double>& p, Trial trial) {
  Search result;
  if (!(trial.alpha > 0.0)) {
    result.result = SearchResult::kBlocked;
    return result;
  }
  const double slope = dot(walk.g(), p);
  const std::vector<double> start = walk.x();

  for (; result.backtracks < kLineSearch.backtracks; ++result.backtracks, trial.alpha *= 0.5) {
    walk.context.checkpoint->check();
    if (result.backtracks > 0) {
      if (walk.f.coordinates->is_curved(p)) {
        trial.alpha = walk.watch(p, trial.alpha, trial.to);
        if (!(trial.alpha > 0.0)) break;
      } else {
        walk.f.coordinates->retract(start, p, trial.alpha, trial.to);
      }
      trial.gain = walk.change(trial.to);
    }
    const bool decreased = trial.gain <= trial.enough(slope);
    if (!decreased && !drowns(walk, trial.gain)) continue;
    if (decreased) {
      walk.f.update_duals(start.data(), p.data(), trial.alpha, trial.to.data());
      walk.go(trial.to, trial.gain);
      walk.refresh();
    } else if (!walk.go_if_flat(trial.to, p, kLineSearch.wolfe_slope * std::abs(slope))) {
      continue;
    }
    result.result = SearchResult::kMoved;
    result.alpha = trial.alpha;
    result.gain = trial.gain;
    result.measured = decreased;
    return result;
  }
  return result;
}

}  // namespace diffcloth::solver
