#pragma once

#include <array>

namespace diffcloth::bodies {

/// What a joint adds to the objective beyond everything quadratic: a limit of its drive's effort, a limit
/// of its speed, and Coulomb friction. With the slip d = q - o and
///
///   a(d) = a_0 - K d     the effort that the drive asks for: its quadratic part pulls with it,
///   s(a)                 the effort that it has: a up to 0.9 L, then smoothly on to L, never beyond,
///
/// the term is
///
///   int (a - s(a)) dd  +  tau f0(|d|; eps h)  +  (k + F / w) (b(u+) + b(u-)),
///
/// where f0 is the law of contact (common/friction_law.h), u = v h + w -+ d is what is left to the end of a
/// zone of width w = `zone` v h beyond the limit v of the speed, and b is the barrier of limits. The first
/// part is zero where the drive has what it asks for. It is concave, and convex together with the
/// quadratic part, which has the curvature K.
struct JointTerm {
  double origin;          ///< o
  double effort;          ///< a_0 [N m or N]
  double stiffness;       ///< K
  double effort_limit;    ///< L
  double velocity_limit;  ///< v
  double friction;        ///< tau [N m or N]
  double slip_rate;       ///< eps
};
inline constexpr int kJointColumns = 7;
using JointRow = std::array<double, kJointColumns>;

/// The term of a row, whose columns are its fields in their order.
inline JointTerm joint_term(const double* row) {
  return {.origin = row[0],
          .effort = row[1],
          .stiffness = row[2],
          .effort_limit = row[3],
          .velocity_limit = row[4],
          .friction = row[5],
          .slip_rate = row[6]};
}

/// A drive has what it asks for up to this share of its limit.
inline constexpr double kLinearShare = 0.9;

/// What does not change with the inputs.
struct JointConstants {
  double h;                   ///< [s]
  double zone;                ///< share of its limit by which a speed may be beyond
  double velocity_stiffness;  ///< k
  double velocity_force;      ///< F
};

/// The derivative of a joint's term by its coordinate, and the derivatives of that. With v the direction of
/// friction, between -1 and 1, its curvature is `sticking` + `turning` v.
struct JointForce {
  double slope = 0.0;
  double curvature = 0.0;  ///< without friction
  double sticking = 0.0;   ///< tau f1 / |d|, of a majorant of friction
  double turning = 0.0;    ///< tau f2 d / (f1 / |d|)
  double friction = 0.0;   ///< v = f1 d / |d|
  JointRow by{};           ///< derivatives of the slope by the columns of the term, in their order
};

/// The term at `to` less that at `from`, without cancellation; not finite beyond the end of a limit.
double joint_energy_change(const JointTerm& term, const JointConstants& c, double from, double to);

JointForce joint_force(const JointTerm& term, const JointConstants& c, double q);

/// The barrier of a limit, -(u - w)^2 log(u / w), where u < w of the zone's width is left to its end; 0
/// beyond, infinite where nothing is left. Its derivatives by u hold for 0 < u < w.
double limit_barrier(double u, double w);
double limit_slope(double u, double w);
double limit_curvature(double u, double w);

}  // namespace diffcloth::bodies
