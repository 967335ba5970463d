#include "contact/ccd.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "common/types.h"
#include "contact/distance/separation.h"

namespace diffcloth::contact {
namespace {

/// Fraction of the initial gap, or of the barrier distance if smaller, that remains at the end of a safe
/// step.
constexpr double kGapLeft = 0.1;

/// The iteration stops if it advances by less than this relative step in time.
constexpr double kSettled = 1e-12;

/// Rounding error of positions, relative to the largest coordinate; smaller gaps count as contact.
constexpr double kPositionRounding = 1e-12;

/// Iteration limit; the safe time reached by then is returned.
constexpr int kMaxIterations = 1000;

using Differences = std::array<Vec3, 4>;

/// Vectors from the corners of the second primitive to the corners of the first: four for two edges,
/// three for a point and a triangle (the fourth repeats the third).
Differences between(PairKind kind, const Corners& x) {
  switch (kind) {
    case PairKind::kPointTriangle:
      return {x[0] - x[1], x[0] - x[2], x[0] - x[3], x[0] - x[3]};
    case PairKind::kEdgeEdge:
      return {x[0] - x[2], x[0] - x[3], x[1] - x[2], x[1] - x[3]};
  }
  __builtin_unreachable();
}

/// True if the boxes around the two motions are farther apart than `gap` along an axis. Coordinates must
/// be finite.
bool stay_apart(PairKind kind, const Corners& x_t0, const Corners& x_t1, double gap) {
  std::array<Vec3, 4> lo;
  std::array<Vec3, 4> hi;
  for (int i = 0; i < 4; ++i) {
    lo[i] = x_t0[i].cwiseMin(x_t1[i]);
    hi[i] = x_t0[i].cwiseMax(x_t1[i]);
  }
  const int last_of_a = kind == PairKind::kPointTriangle ? 0 : 1;
  const int first_of_b = last_of_a + 1;
  const Vec3 lo_a = lo[0].cwiseMin(lo[last_of_a]);
  const Vec3 hi_a = hi[0].cwiseMax(hi[last_of_a]);
  const Vec3 lo_b = lo[first_of_b].cwiseMin(lo[2]).cwiseMin(lo[3]);
  const Vec3 hi_b = hi[first_of_b].cwiseMax(hi[2]).cwiseMax(hi[3]);
  return ((lo_a - hi_b).array() > gap).any() || ((lo_b - hi_a).array() > gap).any();
}

/// Latest time up to which n . (start + time motion) >= bound holds from t on, for all differences;
/// -infinity if the inequality does not hold at t.
double certified_time(
    const Vec3& n, const Differences& start, const Differences& motion, double t, double bound) {
  double time = std::numeric_limits<double>::infinity();
  for (int k = 0; k < 4; ++k) {
    const double speed = n.dot(motion[k]);
    const double gap = n.dot(start[k]) - bound;
    if (speed < 0) {
      time = std::min(time, -gap / speed);
    } else if (!(gap + speed * t >= 0)) {
      return -std::numeric_limits<double>::infinity();
    }
  }
  return time;
}

}  // namespace

double harmless_distance(double xi, double d_hat, double largest) {
  // With this margin each iteration advances by more than kSettled, whatever the rounding.
  constexpr double kClearly = 10.0;
  return xi + kGapLeft * d_hat + kClearly * kPositionRounding * largest;
}

double safe_step(PairKind kind,
                 const Corners& x_t0,
                 const Corners& x_t1,
                 double xi,
                 double d_hat,
                 double limit) {
  double largest = 0;
  Corners U;
  for (int i = 0; i < 4; ++i) {
    largest = std::max({largest, x_t0[i].cwiseAbs().maxCoeff(), x_t1[i].cwiseAbs().maxCoeff()});
    U[i] = x_t1[i] - x_t0[i];
  }
  const Differences motion = between(kind, U);
  double lp_sq = 0;
  for (const Vec3& m : motion) {
    if (!std::isfinite(m.squaredNorm())) return 0;  // nothing can be certified
    lp_sq = std::max(lp_sq, m.squaredNorm());
  }
  const double touching = xi + kPositionRounding * largest;
  const double most = kGapLeft * d_hat;
  if (stay_apart(kind, x_t0, x_t1, touching + most)) return limit;
  Vec3 d_vector = separation(kind, x_t0);
  double d = d_vector.norm();
  if (!(d > touching)) return 0;
  const Differences start = between(kind, x_t0);
  const double lp = std::sqrt(lp_sq);

  const double g = std::min(kGapLeft * (d - xi), most);
  double t = 0;
  for (int iteration = 0; iteration < kMaxIterations; ++iteration) {
    const double next =
        std::max(t + (d - xi - g) / lp, certified_time(d_vector / d, start, motion, t, xi + g));
    if (next >= limit) return limit;
    if (!(next > t + kSettled * t)) break;
    t = next;
    Corners x;
    for (int i = 0; i < 4; ++i) x[i] = x_t0[i] + t * U[i];
    d_vector = separation(kind, x);
    d = d_vector.norm();
  }
  return t;
}

}  // namespace diffcloth::contact
