#include "solver/objective.h"

namespace diffcloth::solver {

linalg::Couplings Objective::couplings() const {
  linalg::Couplings all;
  for_each([&](const Potential& p) { p.add_couplings(all); });
  const linalg::BlockPattern& base = assemblies->base();
  std::erase_if(all, [&](const std::pair<Index, Index>& pair) {
    const auto [i, j] = pair;
    if (i >= base.size() || !coordinates->is_free(i) || !coordinates->is_free(j)) return true;
    const Index k = base.slot(i, j);
    return k < base.column_start()[j + 1] && base.row()[k] == i;
  });
  linalg::sort_couplings(all);
  return all;
}

}  // namespace diffcloth::solver
