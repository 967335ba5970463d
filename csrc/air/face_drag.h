#pragma once

#include <cmath>

#include "common/types.h"

namespace diffcloth::air {

/// Power that a face loses to air which flows past it with velocity -u,
///
///   D(u) = A / 3 (a |u_n|^3 + b |u_t|^3),    u_n = n . u,  u_t = u - u_n n,
///
/// whose gradient is minus the force: a pressure a |u_n| u_n across the face, and a friction b |u_t| u_t
/// along it. Each depends on its own part of the velocity alone (the independence principle of Taylor
/// 1952); lift is the component of the pressure on a tilted face that is orthogonal to the flow. D is
/// convex, so that implicit steps lose energy for any time step.
///
/// Normal and area are n = N / |N| and A = |N| / 2 with N = (x_1 - x_0) x (x_2 - x_0). A face without
/// area has no force.
///
/// References:
///     Taylor, "Analysis of the swimming of long and narrow animals", Proceedings of the Royal Society A 214
///     (1952).
struct FaceDrag {
  Vec3 n = Vec3::Zero();
  double area = 0.0;    ///< [m^2]
  double across = 0.0;  ///< a [kg/m^3]
  double along = 0.0;   ///< b [kg/m^3]

  FaceDrag(const Vec3& N, double across_in, double along_in)
      : area(0.5 * N.norm()), across(across_in), along(along_in) {
    if (area > 0.0) n = N / (2.0 * area);
  }

  Vec3 tangential(const Vec3& u) const { return u - n.dot(u) * n; }

  /// D [W].
  double power(const Vec3& u) const {
    return area / 3.0 * (across * cube(std::abs(n.dot(u))) + along * cube(tangential(u).norm()));
  }

  /// D(to) - D(u), for to = u + d, without cancellation.
  double power_change(const Vec3& u, const Vec3& to, const Vec3& d) const {
    const double across_change =
        change_of_cube(std::abs(n.dot(u)), std::abs(n.dot(to)), n.dot(d) * n.dot(u + to));
    const Vec3 sum = tangential(u + to);
    const double along_change =
        change_of_cube(tangential(u).norm(), tangential(to).norm(), d.dot(sum));
    return area / 3.0 * (across * across_change + along * along_change);
  }

  /// grad D [N], and its derivatives by a and by b.
  Vec3 force(const Vec3& u) const { return across * by_across(u) + along * by_along(u); }
  Vec3 by_across(const Vec3& u) const {
    const double u_n = n.dot(u);
    return (area * std::abs(u_n) * u_n) * n;
  }
  Vec3 by_along(const Vec3& u) const {
    const Vec3 u_t = tangential(u);
    return (area * u_t.norm()) * u_t;
  }

  /// Second derivative of D, positive semi-definite [N s/m].
  Mat3 slope(const Vec3& u) const {
    const Vec3 u_t = tangential(u);
    const double speed = u_t.norm();
    Mat3 H = (2.0 * across * std::abs(n.dot(u)) - along * speed) * n * n.transpose();
    H.diagonal().array() += along * speed;
    if (speed > 0.0) H += (along / speed) * u_t * u_t.transpose();
    return area * H;
  }

  /// Derivative of z . grad D by N.
  Vec3 frame_bar(const Vec3& u, const Vec3& z) const {
    const double u_n = n.dot(u);
    const double z_n = n.dot(z);
    const double speed_n = std::abs(u_n);
    const Vec3 u_t = tangential(u);
    const double speed = u_t.norm();
    const double s = u_t.dot(z);
    Vec3 bar = across * (2.0 * speed_n * z_n * u + speed_n * u_n * (z - 2.0 * z_n * n));
    bar += along * (speed * (s * n - z_n * u_t - u_n * tangential(z)));
    if (speed > 0.0) bar -= (along * u_n * s / speed) * u_t;
    return 0.5 * bar;
  }

  /// Change of grad D with a change of N: the transpose of frame_bar().
  Vec3 frame_change(const Vec3& u, const Vec3& N_dot) const {
    const double u_n = n.dot(u);
    const double N_n = n.dot(N_dot);
    const double speed_n = std::abs(u_n);
    const Vec3 u_t = tangential(u);
    const double speed = u_t.norm();
    const double s = u_t.dot(N_dot);
    Vec3 change =
        across * (2.0 * speed_n * u.dot(N_dot) * n + speed_n * u_n * (N_dot - 2.0 * N_n * n));
    change += along * (speed * (N_n * u_t - s * n - u_n * tangential(N_dot)));
    if (speed > 0.0) change -= (along * u_n * s / speed) * u_t;
    return 0.5 * change;
  }

 private:
  static double cube(double r) { return r * r * r; }

  /// b^3 - a^3, for b^2 - a^2 = difference.
  static double change_of_cube(double a, double b, double difference) {
    return a + b > 0.0 ? difference / (a + b) * (a * a + a * b + b * b) : 0.0;
  }
};

}  // namespace diffcloth::air
