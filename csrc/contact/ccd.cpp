#include "contact/ccd.h"

#include <algorithm>
#include <cmath>

namespace diffcloth::contact {
namespace {

constexpr double kRounding = 1e-12;   ///< of the coordinates, relative
constexpr double kTargetGap = 0.1;    ///< of the initial gap, at which the motion is stopped
constexpr double kStepShare = 0.9;    ///< of the gap, spent by a distance step
constexpr int kIterations = 10000;    ///< beyond it the safe fraction reached so far is returned

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
    double step = kStepShare * (d - xi_safe) / fastest;
    const Vec3 n = k.t / d;
    double certified = 2.0;
    for (int i = 0; i < split; ++i) {
      for (int j = split; j < 4; ++j) {
        const double closing = n.dot(u[i] - u[j]);
        if (closing >= 0.0) continue;
        certified = std::min(certified, (n.dot(x[i] - x[j]) - (xi_safe + gap)) / -closing);
      }
    }
    step = std::max(step, certified);
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
