#include "solver/objective.h"

#include <utility>

namespace diffcloth::solver {

std::vector<double> Objective::metric() const {
  std::vector<double> result;
  for (const double m : inertia->metric()) result.insert(result.end(), 3, m / (h * h));
  if (chart != nullptr) chart->append_diagonal(result);
  // Rows of prescribed coordinates alone are fixed.
  result.resize(coordinates->size(), 0.0);
  return result;
}

linalg::Couplings Objective::couplings() const {
  linalg::Couplings points;
  for_each([&](const Potential& p) { p.add_couplings(points); });
  return linalg::beyond(assemblies->base(), coordinates->couplings_of_rows(std::move(points)));
}

}  // namespace diffcloth::solver
