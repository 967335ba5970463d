#include "bodies/joint_term.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/friction_law.h"

namespace diffcloth::bodies {
namespace {

/// An effort beyond the linear part, a = sign (kLinearShare L + w r), is limited to
/// sign (kLinearShare L + w r / s).
struct Excess {
  Excess(double a, double limit)
      : w((1.0 - kLinearShare) * limit),
        r(std::max(std::abs(a) - kLinearShare * limit, 0.0) / w),
        s(std::sqrt(1.0 + r * r)) {}

  double limited() const { return w * r / s; }
  double lost() const { return w * r * (r * r / (s * (s + 1.0))); }  ///< w r - w r / s
  double slope() const { return 1.0 / (s * s * s); }                 ///< d limited() / da

  double w;
  double r;
  double s;
};

/// Change of the integral of a - s(a) over the slip, on one side of zero.
///
/// @param a, b  efforts at its ends, with the sign of the side positive
double lost_work(double a, double b, double slip, const JointTerm& term) {
  const Excess from(std::max(a, 0.0), term.effort_limit);
  const Excess to(std::max(b, 0.0), term.effort_limit);
  if (from.r == 0.0 && to.r == 0.0) return 0.0;
  const double mean = from.w * (from.r + to.r) * (0.5 - 1.0 / (from.s + to.s));
  // If only a part of the motion exceeds the linear range, use that part of the slip.
  if (from.r == 0.0 || to.r == 0.0) slip = from.w * (from.r - to.r) / term.stiffness;
  return mean * slip;
}

/// f0(|to|) - f0(|from|).
double friction_change(double from, double to, double e) {
  const double a = std::abs(from);
  const double b = std::abs(to);
  if (a >= e && b >= e) return b - a;
  if (a >= e || b >= e) return friction_law(b, e).f0 - friction_law(a, e).f0;
  return (b - a) * ((a + b) / e - (a * a + a * b + b * b) / (3.0 * e * e));
}

/// Zone beyond a speed limit, in units of the slip.
struct Zone {
  Zone(const JointTerm& term, const JointConstants& c)
      : reach(term.velocity_limit * c.h),
        w(c.zone * reach),
        stiffness(c.velocity_stiffness + c.velocity_force / w) {}

  double left(double sign, double slip) const { return reach + w - sign * slip; }

  double reach;
  double w;
  double stiffness;
};

}  // namespace

double limit_barrier(double u, double w) {
  if (u >= w) return 0.0;
  if (!(u > 0.0)) return std::numeric_limits<double>::infinity();
  return -(u - w) * (u - w) * std::log(u / w);
}

double limit_slope(double u, double w) {
  return -2.0 * (u - w) * std::log(u / w) - (u - w) * (u - w) / u;
}

double limit_curvature(double u, double w) {
  const double r = (u - w) / u;
  return -2.0 * std::log(u / w) - 4.0 * r + r * r;
}

double joint_energy_change(const JointTerm& term, const JointConstants& c, double from, double to) {
  const double slip = to - from;
  const double d0 = from - term.origin;
  const double d1 = to - term.origin;
  const double a0 = term.effort - term.stiffness * d0;
  const double a1 = term.effort - term.stiffness * d1;
  double change = lost_work(a0, a1, slip, term) + lost_work(-a0, -a1, -slip, term);
  if (term.friction > 0.0) change += term.friction * friction_change(d0, d1, term.slip_rate * c.h);
  const Zone zone(term, c);
  for (const double sign : {1.0, -1.0}) {
    const double b0 = limit_barrier(zone.left(sign, d0), zone.w);
    const double b1 = limit_barrier(zone.left(sign, d1), zone.w);
    if (b0 != 0.0 || b1 != 0.0) change += zone.stiffness * (b1 - b0);
  }
  return change;
}

JointForce joint_force(const JointTerm& term, const JointConstants& c, double q) {
  JointForce f;
  auto& [by_origin, by_effort, by_stiffness, by_effort_limit, by_velocity_limit, by_friction,
         by_slip_rate] = f.by;
  const double d = q - term.origin;

  const double a = term.effort - term.stiffness * d;
  const Excess excess(a, term.effort_limit);
  if (excess.r > 0.0) {
    const double sign = a < 0.0 ? -1.0 : 1.0;
    const double lost = 1.0 - excess.slope();
    f.slope += sign * excess.lost();
    f.curvature -= term.stiffness * lost;
    by_effort = lost;
    by_stiffness = -d * lost;
    // s(a) is homogeneous in a and L.
    const double limited = sign * (kLinearShare * term.effort_limit + excess.limited());
    by_effort_limit = -(limited - a * excess.slope()) / term.effort_limit;
  }

  const Zone zone(term, c);
  for (const double sign : {1.0, -1.0}) {
    const double u = zone.left(sign, d);
    if (!(u < zone.w)) continue;
    const double slope = limit_slope(u, zone.w);
    const double curvature = limit_curvature(u, zone.w);
    f.slope -= sign * zone.stiffness * slope;
    f.curvature += zone.stiffness * curvature;
    // b' is homogeneous in u and w, and u = (1 + zone) reach - sign d, w = zone reach.
    const double by_width = (slope - u * curvature) / zone.w;
    const double by_reach = (1.0 + c.zone) * curvature + c.zone * by_width;
    const double stiffness_by_reach = -c.velocity_force / (zone.w * zone.reach);
    by_velocity_limit -= sign * c.h * (zone.stiffness * by_reach + stiffness_by_reach * slope);
  }

  const FrictionLaw law = friction_law(std::abs(d), term.slip_rate * c.h);
  f.friction = law.f1_over_y * d;
  f.slope += term.friction * f.friction;
  f.sticking = term.friction * law.f1_over_y;
  f.turning = term.friction * (law.f2 / law.f1_over_y * d);
  by_slip_rate = term.friction * d * law.f1_over_y_e * c.h;
  by_friction = f.friction;
  by_origin = -(f.curvature + f.sticking + f.turning * f.friction);
  return f;
}

}  // namespace diffcloth::bodies
