#include "contact/distance/closest.h"

#include <limits>

#include "contact/distance/point_edge.h"

namespace diffcloth::contact {
namespace {

/// Below this squared sine two directions count as parallel, and a triangle as degenerate.
constexpr double kParallel = 2.5e-16;

/// Write the interior closest features of a pair, whose beta solves M beta = rhs.
bool solve_interior(const Eigen::Matrix<double, 3, 2>& s, const Vec3& t0, Vec2& beta, Mat2& M_inv) {
  // t = t0 + s beta is shortest where s^T (t0 + s beta) = 0.
  const double m00 = s.col(0).squaredNorm();
  const double m11 = s.col(1).squaredNorm();
  const double m01 = s.col(0).dot(s.col(1));
  const double determinant = s.col(0).cross(s.col(1)).squaredNorm();
  if (!(determinant >= kParallel * m00 * m11) || determinant == 0.0) return false;
  M_inv << m11, -m01, -m01, m00;
  M_inv /= determinant;
  beta = -M_inv * (s.transpose() * t0);
  return true;
}

Closest farthest() {
  Closest k;
  k.d_sq = std::numeric_limits<double>::infinity();
  k.c.setZero();
  k.t.setZero();
  k.parameter_count = 0;
  return k;
}

Closest point_triangle(const Corners& x) {
  Closest k = farthest();
  k.s.col(0) = x[1] - x[2];
  k.s.col(1) = x[1] - x[3];
  const Vec3 t0 = x[0] - x[1];
  Vec2 beta;
  if (solve_interior(k.s, t0, beta, k.M_inv) && beta[0] >= 0.0 && beta[1] >= 0.0 &&
      beta[0] + beta[1] <= 1.0) {
    k.c << 1.0, -(1.0 - beta[0] - beta[1]), -beta[0], -beta[1];
    k.c_beta << 0, 0, 1, 1, -1, 0, 0, -1;
    k.parameter_count = 2;
    k.t = t0 + k.s * beta;
    k.d_sq = k.t.squaredNorm();
    return k;
  }
  consider_point_edge(x, 0, 1, 2, 1.0, k);
  consider_point_edge(x, 0, 2, 3, 1.0, k);
  consider_point_edge(x, 0, 3, 1, 1.0, k);
  return k;
}

Closest edge_edge(const Corners& x) {
  Closest k = farthest();
  k.s.col(0) = x[1] - x[0];
  k.s.col(1) = x[2] - x[3];
  const Vec3 t0 = x[0] - x[2];
  Vec2 beta;
  if (solve_interior(k.s, t0, beta, k.M_inv) && beta[0] > 0.0 && beta[0] < 1.0 && beta[1] > 0.0 &&
      beta[1] < 1.0) {
    k.c << 1.0 - beta[0], beta[0], -(1.0 - beta[1]), -beta[1];
    k.c_beta << -1, 0, 1, 0, 0, 1, 0, -1;
    k.parameter_count = 2;
    k.t = t0 + k.s * beta;
    k.d_sq = k.t.squaredNorm();
    return k;
  }
  consider_point_edge(x, 0, 2, 3, 1.0, k);
  consider_point_edge(x, 1, 2, 3, 1.0, k);
  consider_point_edge(x, 2, 0, 1, -1.0, k);
  consider_point_edge(x, 3, 0, 1, -1.0, k);
  return k;
}

/// G of the header, 12x2.
Eigen::Matrix<double, 12, 2> coupling(const Closest& k) {
  Eigen::Matrix<double, 12, 2> g = Eigen::Matrix<double, 12, 2>::Zero();
  for (int a = 0; a < k.parameter_count; ++a) {
    for (int i = 0; i < 4; ++i) {
      g.block<3, 1>(3 * i, a) = k.c[i] * k.s.col(a) + k.c_beta(i, a) * k.t;
    }
  }
  return g;
}

}  // namespace

Closest closest(PairKind kind, const Corners& x) {
  return kind == PairKind::kPointTriangle ? point_triangle(x) : edge_edge(x);
}

Vec12 distance_sq_gradient(const Closest& k) {
  Vec12 g;
  for (int i = 0; i < 4; ++i) g.segment<3>(3 * i) = (2.0 * k.c[i]) * k.t;
  return g;
}

Mat12 distance_sq_hessian(const Closest& k) {
  Mat12 h = Mat12::Zero();
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 4; ++j) {
      h.block<3, 3>(3 * i, 3 * j).diagonal().setConstant(2.0 * k.c[i] * k.c[j]);
    }
  }
  if (k.parameter_count == 0) return h;
  const Eigen::Matrix<double, 12, 2> g = coupling(k);
  if (k.parameter_count == 1) {
    h.noalias() -= (2.0 * k.M_inv(0, 0)) * g.col(0) * g.col(0).transpose();
  } else {
    h.noalias() -= 2.0 * g * k.M_inv * g.transpose();
  }
  return h;
}

Eigen::Matrix<double, 2, 12> beta_jacobian(const Closest& k) {
  if (k.parameter_count == 0) return Eigen::Matrix<double, 2, 12>::Zero();
  Mat2 M_inv = k.M_inv;
  if (k.parameter_count == 1) M_inv(0, 1) = M_inv(1, 0) = M_inv(1, 1) = 0.0;
  return -M_inv * coupling(k).transpose();
}

double distance_sq(PairKind kind, const Corners& x) { return closest(kind, x).d_sq; }

}  // namespace diffcloth::contact
