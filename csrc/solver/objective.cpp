#include "solver/objective.h"

#include <algorithm>
#include <iterator>
#include <tuple>
#include <utility>

#include "solver/stopping.h"

namespace diffcloth::solver {
namespace {

/// Couplings of points as sorted couplings of rows that the base pattern lacks.
linalg::Couplings beyond_base(const Objective& f, linalg::Couplings points) {
  return linalg::beyond(f.patterns->base(), f.coordinates->couplings_of_rows(std::move(points)));
}

/// Sorted union of two lists of couplings.
linalg::Couplings united(const linalg::Couplings& a, const linalg::Couplings& b) {
  linalg::Couplings all;
  all.reserve(a.size() + b.size());
  const auto by_column = [](const auto& p, const auto& q) {
    return std::tie(p.second, p.first) < std::tie(q.second, q.first);
  };
  std::ranges::set_union(a, b, std::back_inserter(all), by_column);
  return all;
}

}  // namespace

std::vector<double> Objective::metric() const {
  std::vector<double> result;
  for (const double m : inertia->metric()) result.insert(result.end(), 3, m / (h * h));
  if (chart != nullptr) chart->append_diagonal(result);
  // Rows whose coordinates are all prescribed are fixed.
  result.resize(coordinates->size(), 0.0);
  return result;
}

double Objective::largest_fraction(const std::vector<double>& x,
                                   const std::vector<double>& dx) const {
  const double fraction = coordinates->largest_fraction(x, dx);
  if (chart == nullptr) return fraction;
  return std::min(
      fraction, chart->largest_fraction(x.data(), dx.data(), stopping::kJointSteps.share_of_limit));
}

std::shared_ptr<const AnalyzedPattern> Objective::pattern() const {
  linalg::Couplings points;
  for_each([&](const Potential& p) {
    if (&p != friction) p.add_couplings(points);
  });
  if (known_pattern.pattern != nullptr && known_pattern.points == points) {
    return known_pattern.pattern;
  }
  linalg::Couplings all = united(expected, beyond_base(*this, points));
  if (friction != nullptr) {
    if (!of_friction) {
      linalg::Couplings of_its_points;
      friction->add_couplings(of_its_points);
      of_friction = beyond_base(*this, std::move(of_its_points));
    }
    all = united(all, *of_friction);
  }
  known_pattern = {.points = std::move(points), .pattern = patterns->find(all)};
  return known_pattern.pattern;
}

void Objective::expect(linalg::Couplings points) {
  expected = beyond_base(*this, std::move(points));
  known_pattern.pattern = nullptr;
}

}  // namespace diffcloth::solver
