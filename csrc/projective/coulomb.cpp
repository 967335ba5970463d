#include "projective/coulomb.h"

#include <algorithm>

namespace diffcloth::projective {
namespace {

/// Bound of the ratio: such slow slip is as stiff as sticking, and a factor can still resolve the other
/// entries.
constexpr double kLargestRatio = 1e8;

}  // namespace

Coulomb coulomb(const Vec3& s, const Vec3& normal, double friction) {
  Coulomb law;
  const double s_n = s.dot(normal);
  if (!(s_n > 0.0)) return law;
  const Vec3 s_t = s - s_n * normal;
  const double tangential = s_t.norm();
  const double limit = friction * s_n;
  if (friction > 0.0 && tangential <= limit) {
    law.kind = ContactCase::kSticking;
    law.impulse = s;
    return law;
  }
  law.kind = ContactCase::kSlipping;
  if (tangential > 0.0) law.direction = s_t / tangential;
  law.impulse = s_n * normal + limit * law.direction;
  if (limit > 0.0) law.ratio = std::min(limit / (tangential - limit), kLargestRatio);
  return law;
}

}  // namespace diffcloth::projective
