#include "contact/distance/mollifier.h"

namespace diffcloth::contact {
namespace {

double cross_sq(const Corners& x) { return (x[1] - x[0]).cross(x[3] - x[2]).squaredNorm(); }

}  // namespace

double mollifier_threshold(double rest_length_sq_a, double rest_length_sq_b) {
  return 1e-3 * rest_length_sq_a * rest_length_sq_b;
}

bool mollified(const Corners& x, double eps) { return cross_sq(x) < eps; }

double mollifier(const Corners& x, double eps) {
  const double r = cross_sq(x) / eps;
  return r < 1.0 ? r * (2.0 - r) : 1.0;
}

// q = |u|^2 |v|^2 - (u.v)^2:
//   dq/du = 2 (|v|^2 u - (u.v) v),  d2q/du2 = 2 (|v|^2 I - v v^T),
//   d2q/dudv = 2 (2 u v^T - v u^T - (u.v) I).
Mollifier mollifier_derivatives(const Corners& x, double eps) {
  const double q = cross_sq(x);
  if (q >= eps) {
    return {.m = 1.0,
            .gradient = Vec12::Zero(),
            .hessian = Mat12::Zero(),
            .m_eps = 0.0,
            .gradient_eps = Vec12::Zero()};
  }
  const Vec3 u = x[1] - x[0];
  const Vec3 v = x[3] - x[2];
  const double uv = u.dot(v);
  const Mat3 identity = Mat3::Identity();
  const Vec3 q_u = 2.0 * (v.squaredNorm() * u - uv * v);
  const Vec3 q_v = 2.0 * (u.squaredNorm() * v - uv * u);
  const Mat3 q_uu = 2.0 * (v.squaredNorm() * identity - v * v.transpose());
  const Mat3 q_vv = 2.0 * (u.squaredNorm() * identity - u * u.transpose());
  const Mat3 q_uv = 2.0 * (2.0 * u * v.transpose() - v * u.transpose() - uv * identity);

  Vec12 q_x;
  q_x << -q_u, q_u, -q_v, q_v;
  Mat12 q_xx;
  q_xx << q_uu, -q_uu, q_uv, -q_uv,  //
      -q_uu, q_uu, -q_uv, q_uv,      //
      q_uv.transpose(), -q_uv.transpose(), q_vv, -q_vv,  //
      -q_uv.transpose(), q_uv.transpose(), -q_vv, q_vv;

  const double r = q / eps;
  const double m_q = (2.0 - 2.0 * r) / eps;
  const double m_qq = -2.0 / (eps * eps);
  return {.m = r * (2.0 - r),
          .gradient = m_q * q_x,
          .hessian = m_qq * q_x * q_x.transpose() + m_q * q_xx,
          .m_eps = -m_q * r,
          .gradient_eps = (4.0 * r - 2.0) / (eps * eps) * q_x};
}

}  // namespace diffcloth::contact
