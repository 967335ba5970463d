#include "solver/saddle.h"

#include <algorithm>
#include <cmath>

#include "common/fixed_noise.h"
#include "solver/stopping.h"

namespace diffcloth::solver {

using stopping::kSaddle;

namespace {

/// A fixed start without symmetry.
std::vector<double> start_vector(const Coordinates& coordinates) {
  std::vector<double> d(coordinates.size(), 0.0);
  FixedNoise noise;
  for (Index i = 0; i < coordinates.row_count(); ++i) {
    if (!coordinates.is_free(i)) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) d[a] = noise();
  }
  return d;
}

Factor shifted_factor(const std::vector<double>& metric,
                      LinearSystem& system,
                      const Checkpoint& checkpoint,
                      const linalg::BlockMatrix& exact) {
  linalg::BlockMatrix H = exact;
  double added = 0.0;
  double shift = kSaddle.first_shift;
  for (int k = 0; k < kSaddle.shifts; ++k, shift *= kSaddle.shift_growth) {
    checkpoint.check();
    for (Index i = 0; i < H.pattern().size(); ++i) {
      H.add_to_diagonal(i, (shift - added) * row(metric.data(), i));
    }
    added = shift;
    if (Factor factor = system.factor_in_doubles(H)) return factor;
  }
  return nullptr;
}

/// Move to the first lower point along p, from far to near, and continue while the next is lower still.
bool go_down(Walk& walk, const std::vector<double>& p) {
  const double length = kSaddle.first_move * walk.f.length;
  std::vector<double> to;
  double alpha = walk.watch(p, std::min(length, walk.f.largest_fraction(walk.x(), p)), to);
  double best = 0.0;
  double best_alpha = 0.0;
  for (int k = 0; k < kSaddle.backtracks; ++k, alpha *= 0.5) {
    if (k > 0) alpha = walk.watch(p, alpha, to);
    if (!(alpha > 0.0)) break;
    const double change = walk.change(to);
    if (change < best) {
      best = change;
      best_alpha = alpha;
    } else if (best_alpha > 0.0) {
      break;
    }
  }
  if (best_alpha == 0.0 || !(walk.watch(p, best_alpha, to) > 0.0)) return false;
  walk.go(to);
  walk.refresh();
  return true;
}

}  // namespace

std::vector<double> most_negative(const Objective& f,
                                  LinearSystem& system,
                                  const Checkpoint& checkpoint,
                                  const linalg::BlockMatrix& H) {
  const std::vector<double> metric = f.metric();
  const Factor shifted = shifted_factor(metric, system, checkpoint, H);
  if (!shifted) return {};
  std::vector<double> d = start_vector(*f.coordinates);
  std::vector<double> b(d.size(), 0.0);
  std::vector<double> p;
  for (int k = 0; k < kSaddle.inverse_iterations; ++k) {
    checkpoint.check();
    for (std::size_t a = 0; a < d.size(); ++a) b[a] = metric[a] * d[a];
    shifted->solve(b.data(), d.data());
    f.coordinates->push_forward(d, p);
    const double size = f.coordinates->displacement(p);
    for (double& value : d) value /= size;
  }
  // The largest entry decides the sign; of equal entries, the first.
  const auto top = std::ranges::max_element(d, {}, [](double value) { return std::abs(value); });
  if (*top < 0.0) {
    for (double& value : d) value = -value;
  }
  b.assign(d.size(), 0.0);
  H.add_product(d.data(), b.data());
  if (!(dot(d, b) < 0.0)) return {};
  return d;
}

bool leave_saddle(Walk& walk) {
  const linalg::BlockMatrix H = walk.system.assemble(walk.x().data(), Curvature::kExact, walk.g());
  const std::vector<double> d = most_negative(walk.f, walk.system, *walk.context.checkpoint, H);
  if (d.empty()) return false;
  std::vector<double> p;
  walk.f.coordinates->push_forward(d, p);
  if (go_down(walk, p)) return true;
  // The remaining gradient may outweigh the curvature on one side.
  for (double& value : p) value = -value;
  return go_down(walk, p);
}

}  // namespace diffcloth::solver
