#pragma once

#include <array>

namespace diffcloth::bodies {

/// Nonquadratic terms of a joint in the objective: a limit of its drive's effort, a limit of its speed,
/// and Coulomb friction. With the slip d = q - o and
///
///   a(d) = a_0 - K d     effort requested from the drive, as in its quadratic term,
///   s(a)                 available effort: a up to 0.9 L, then approaching L smoothly from below,
///
/// the term is
///
///   int (a - s(a)) dd  +  tau f0(|d|; eps h)  +  (k + F / w) (b(u+) + b(u-)),
///
/// where f0 is the friction law of contact (common/friction_law.h), u = v h + w -+ d is the distance
/// left to the end of a zone of width w = `zone` v h beyond the speed limit v, and b is the barrier of
/// limits. The first part is zero while the drive has the requested effort. It is concave, but convex
/// together with the quadratic term, whose curvature is K.
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

/// JointTerm of a row, whose columns are the fields in their order.
inline JointTerm joint_term(const double* row) {
  return {.origin = row[0],
          .effort = row[1],
          .stiffness = row[2],
          .effort_limit = row[3],
          .velocity_limit = row[4],
          .friction = row[5],
          .slip_rate = row[6]};
}

/// Fraction of its limit up to which a drive has the requested effort.
inline constexpr double kLinearShare = 0.9;

/// Parameters that are not differentiated.
struct JointConstants {
  double h;                   ///< [s]
  double zone;                ///< relative width of the zone beyond a speed limit
  double velocity_stiffness;  ///< k
  double velocity_force;      ///< F
};

/// Derivative of a joint's term by its coordinate, and its own derivatives. With the direction v of
/// friction, between -1 and 1, the curvature of friction is `sticking` + `turning` v.
struct JointForce {
  double slope = 0.0;
  double curvature = 0.0;  ///< without friction
  double sticking = 0.0;   ///< tau f1 / |d|, curvature of a majorant of friction
  double turning = 0.0;    ///< tau f2 d / (f1 / |d|)
  double friction = 0.0;   ///< v = f1 d / |d|
  JointRow by{};           ///< derivatives of the slope by the columns of the term, in their order
};

/// Term at `to` minus term at `from`, without cancellation; not finite beyond the end of a limit.
double joint_energy_change(const JointTerm& term, const JointConstants& c, double from, double to);

JointForce joint_force(const JointTerm& term, const JointConstants& c, double q);

/// Barrier of a limit, -(u - w)^2 log(u / w) for 0 < u < w, with the distance u left to the end of its
/// zone of width w; 0 for u >= w, infinite for u <= 0. The derivatives by u hold for 0 < u < w.
double limit_barrier(double u, double w);
double limit_slope(double u, double w);
double limit_curvature(double u, double w);

}  // namespace diffcloth::bodies
