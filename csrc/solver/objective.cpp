#include "solver/objective.h"

#include <algorithm>
#include <iterator>
#include <tuple>
#include <utility>

namespace diffcloth::solver {
namespace {

/// Couplings of points as sorted ones of rows that the base pattern lacks.
linalg::Couplings beyond_base(const Objective& f, linalg::Couplings points) {
  return linalg::beyond(f.patterns->base(), f.coordinates->couplings_of_rows(std::move(points)));
}

}  // namespace

std::vector<double> Objective::metric() const {
  std::vector<double> result;
  for (const double m : inertia->metric()) result.insert(result.end(), 3, m / (h * h));
  if (chart != nullptr) chart->append_diagonal(result);
  // Rows of prescribed coordinates alone are fixed.
  result.resize(coordinates->size(), 0.0);
  return result;
}

double Objective::largest_fraction(const std::vector<double>& x,
                                   const std::vector<double>& dx) const {
  const double fraction = coordinates->largest_fraction(x, dx);
  if (chart == nullptr) return fraction;
  return std::min(fraction,
                  chart->largest_fraction(x.data(), dx.data(), Coordinates::kShareOfLimit));
}

linalg::Couplings Objective::couplings() const {
  linalg::Couplings points;
  for_each([&](const Potential& p) { p.add_couplings(points); });
  linalg::Couplings here = beyond_base(*this, std::move(points));
  if (expected.empty()) return here;
  linalg::Couplings all;
  all.reserve(expected.size() + here.size());
  const auto by_column = [](const auto& a, const auto& b) {
    return std::tie(a.second, a.first) < std::tie(b.second, b.first);
  };
  std::ranges::set_union(expected, here, std::back_inserter(all), by_column);
  return all;
}

void Objective::expect(linalg::Couplings points) {
  expected = beyond_base(*this, std::move(points));
}

}  // namespace diffcloth::solver
