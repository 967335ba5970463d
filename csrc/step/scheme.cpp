#include "step/scheme.h"

namespace diffcloth::step {

void add_pin_forces(const Problem& problem,
                    const solver::Objective& objective,
                    const std::vector<double>& x,
                    double* pins) {
  const std::vector<Index>& pinned = problem.scene.given.pins;
  if (pinned.empty()) return;
  std::vector<double> g;
  objective.gradient(x.data(), g);
  for (std::size_t p = 0; p < pinned.size(); ++p) {
    for (std::size_t k = 0; k < 3; ++k) pins[3 * p + k] += g[3 * pinned[p] + k];
  }
}

}  // namespace diffcloth::step
