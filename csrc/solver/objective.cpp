#include "solver/objective.h"

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
  linalg::Couplings all = coordinates->couplings_of_rows(points);
  linalg::sort_couplings(all);
  const linalg::BlockPattern& base = assemblies->base();
  std::erase_if(all, [&](const std::pair<Index, Index>& pair) {
    const auto [i, j] = pair;
    const Index k = base.slot(i, j);
    return k < base.column_start()[j + 1] && base.row()[k] == i;
  });
  return all;
}

}  // namespace diffcloth::solver
