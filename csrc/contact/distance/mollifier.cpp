#include "contact/distance/mollifier.h"

#include <Eigen/Geometry>

namespace diffcloth::contact {
namespace {

/// Edges count as parallel if |u x v|^2 is below this fraction of |U|^2 |V|^2: an angle of 1.8 degrees
/// at rest length.
constexpr double kThreshold = 1e-3;
/// Same for the segment of a round body: 18 degrees.
constexpr double kRoundThreshold = 0.1;

double cross_sq(const Corners& x) { return Vec3(x[1] - x[0]).cross(x[3] - x[2]).squaredNorm(); }

}  // namespace

double mollifier_threshold(double rest_length_sq_a, double rest_length_sq_b, bool is_round) {
  return (is_round ? kRoundThreshold : kThreshold) * rest_length_sq_a * rest_length_sq_b;
}

double mollifier(const Corners& x, double eps) {
  const double q = cross_sq(x);
  return q < eps ? (q / eps) * (2 - q / eps) : 1.0;
}

bool mollified(const Corners& x, double eps) { return cross_sq(x) < eps; }

Mollifier mollifier_derivatives(const Corners& x, double eps) {
  const Vec3 u = x[1] - x[0];
  const Vec3 v = x[3] - x[2];
  const Vec3 w = u.cross(v);
  const double q = w.squaredNorm();
  if (!(q < eps)) {
    return {.m = 1,
            .gradient = Vec12::Zero(),
            .hessian = Mat12::Zero(),
            .m_eps = 0,
            .gradient_eps = Vec12::Zero()};
  }
  const double y = q / eps;
  const double m_q = 2 * (1 - y) / eps;
  const double m_qq = -2 / (eps * eps);

  // q by u and v: the corners enter as u = a1 - a0, v = b1 - b0.
  Vec12 q_x;
  q_x.segment<3>(3) = 2 * v.cross(w);
  q_x.segment<3>(9) = 2 * w.cross(u);
  q_x.segment<3>(0) = -q_x.segment<3>(3);
  q_x.segment<3>(6) = -q_x.segment<3>(9);

  const Mat3 q_uu = 2 * (v.squaredNorm() * Mat3::Identity() - v * v.transpose());
  const Mat3 q_vv = 2 * (u.squaredNorm() * Mat3::Identity() - u * u.transpose());
  const Mat3 q_uv = 2 * (2 * u * v.transpose() - u.dot(v) * Mat3::Identity() - v * u.transpose());

  Mat12 hessian;
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 2; ++j) {
      const double sign = i == j ? m_q : -m_q;
      hessian.block<3, 3>(3 * i, 3 * j) = sign * q_uu;
      hessian.block<3, 3>(6 + 3 * i, 6 + 3 * j) = sign * q_vv;
      hessian.block<3, 3>(3 * i, 6 + 3 * j) = sign * q_uv;
      hessian.block<3, 3>(6 + 3 * j, 3 * i) = sign * q_uv.transpose();
    }
  }
  hessian += m_qq * q_x * q_x.transpose();

  return {.m = y * (2 - y),
          .gradient = m_q * q_x,
          .hessian = hessian,
          .m_eps = -2 * (1 - y) * y / eps,
          .gradient_eps = (-2 * (1 - 2 * y) / (eps * eps)) * q_x};
}

}  // namespace diffcloth::contact
