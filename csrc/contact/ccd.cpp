#include "contact/ccd.h"

#include <algorithm>
#include <cmath>

namespace diffcloth::contact {
namespace {

constexpr double kRounding = 1e-12;   ///< of the coordinates, relative
constexpr double kTargetGap = 0.1;    ///< of the initial gap, at which the motion is stopped
constexpr double kStepShare = 0.9;    ///< of the gap, spent by a distance step
constexpr int kIterations = 10000;    ///< beyond it the safe fraction reached so far is returned

/// Unit vector from the second primitive toward the first.
///
/// At a gap of 1e-11 the closest vector t has lost five digits to rounding, as a direction too.
/// Inside two primitives their normal is the same direction, accurate at any gap.
Vec3 separation(const Closest& k) {
  if (k.parameter_count == 2) {
    const Vec3 normal = k.s.col(0).cross(k.s.col(1)).normalized();
    return normal.dot(k.t) < 0.0 ? Vec3(-normal) : normal;
  }
  return k.t.normalized();
}

/// Largest step for which the plane across n keeps the primitives apart by `margin`: then
/// n . (x_i - x_j) >= margin for all vertices i of one and j of the other, at its start and end.
/// This holds for any n, but where n does not separate them to begin with, it is 0.
double certified_step(const Vec3& n, const Corners& x, const Corners& u, int split, double margin) {
  double step = 2.0;
  for (int i = 0; i < split; ++i) {
    for (int j = split; j < 4; ++j) {
      const double slack = n.dot(x[i] - x[j]) - margin;
      if (!(slack >= 0.0)) return 0.0;
      const double closing = n.dot(u[i] - u[j]);
      if (closing < 0.0) step = std::min(step, slack / -closing);
    }
  }
  return step;
}

}  // namespace

double safe_step(PairKind kind, const Corners& x_t0, const Corners& x_t1, double xi) {
  const int split = kind == PairKind::kPointTriangle ? 1 : 2;
  Corners u;
  double magnitude = 0.0;
  for (int i = 0; i < 4; ++i) {
    u[i] = x_t1[i] - x_t0[i];
    magnitude = std::max({magnitude, x_t0[i].cwiseAbs().maxCoeff(), x_t1[i].cwiseAbs().maxCoeff()});
  }
  // The distance below which rounding could hide a contact.
  const double xi_safe = xi + kRounding * magnitude;

  Closest k = closest(kind, x_t0);
  double d = std::sqrt(k.d_sq);
  if (!(d > xi_safe)) return 0.0;
  double fastest = 0.0;
  for (int i = 0; i < split; ++i) {
    for (int j = split; j < 4; ++j) fastest = std::max(fastest, (u[i] - u[j]).norm());
  }
  if (fastest == 0.0) return 1.0;

  const double gap = kTargetGap * (d - xi_safe);
  double t = 0.0;
  Corners x = x_t0;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const double step = std::max(kStepShare * (d - xi_safe) / fastest,
                                 certified_step(separation(k), x, u, split, xi_safe + gap));
    if (t + step >= 1.0) return 1.0;
    t += step;
    for (int i = 0; i < 4; ++i) x[i] = x_t0[i] + t * u[i];
    k = closest(kind, x);
    d = std::sqrt(k.d_sq);
    if (d - xi_safe <= gap) return t;
  }
  return t;
}

}  // namespace diffcloth::contact
