#include "mesh/curvature_fit.h"

#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/Jacobi>

namespace diffcloth::mesh {
namespace {

/// M = U S V^T. Columns of U whose singular value is zero are zero.
struct Svd {
  FitMatrix U;
  Vec3 S;
  Mat3 V;
};

/// Rotates pairs of columns until all are orthogonal [Hestenes 1958]. Eigen's SVD takes five times as
/// long to compile as the rest of this file.
Svd decompose(const FitMatrix& M) {
  Svd svd{.U = M, .S = Vec3::Zero(), .V = Mat3::Identity()};
  constexpr double kOrthogonal = std::numeric_limits<double>::epsilon();
  constexpr int kMaxSweeps = 30;  // quadratic convergence: about five sweeps are needed
  bool rotated = true;
  for (int sweep = 0; rotated && sweep < kMaxSweeps; ++sweep) {
    rotated = false;
    for (const auto& [p, q] : {std::pair(0, 1), std::pair(0, 2), std::pair(1, 2)}) {
      const double a = svd.U.col(p).squaredNorm();
      const double b = svd.U.col(q).squaredNorm();
      const double c = svd.U.col(p).dot(svd.U.col(q));
      if (std::abs(c) <= kOrthogonal * std::sqrt(a * b)) continue;
      rotated = true;
      const double cotangent = (b - a) / (2.0 * c);  // cotangent of twice the angle
      const double t =
          std::copysign(1.0, cotangent) / (std::abs(cotangent) + std::hypot(1.0, cotangent));
      const Eigen::JacobiRotation<double> turn(1.0 / std::hypot(1.0, t), t / std::hypot(1.0, t));
      svd.U.applyOnTheRight(p, q, turn);
      svd.V.applyOnTheRight(p, q, turn);
    }
  }
  svd.S = svd.U.colwise().norm().transpose();
  for (int k = 0; k < 3; ++k) {
    if (svd.S(k) > 0.0) svd.U.col(k) /= svd.S(k);
  }
  return svd;
}

double power7(double s) { return s * s * s * s * s * s * s; }

/// f(s) = s^7 / (s^8 + floor^8).
struct Filter {
  double floor8;

  explicit Filter(double floor) : floor8(floor * power7(floor)) {}

  double denominator(double s) const { return s * power7(s) + floor8; }
  double operator()(double s) const { return power7(s) / denominator(s); }
  double over_s(double s) const { return s * s * s * s * s * s / denominator(s); }

  /// (f(s) - f(t)) / (s - t), without cancellation; t -> -t gives (f(s) + f(t)) / (s + t).
  double divided_difference(double s, double t) const {
    double power_sum = 0.0;  // (s^7 - t^7) / (s - t)
    for (int i = 0; i < 7; ++i) {
      double term = 1.0;
      for (int j = 0; j < 6; ++j) term *= j < i ? s : t;
      power_sum += term;
    }
    return (floor8 * power_sum - power7(s) * power7(t)) / (denominator(s) * denominator(t));
  }
};

}  // namespace

Vec3 singular_values(const FitMatrix& M) { return decompose(M).S; }

FitInverse fit_inverse(const FitMatrix& M, double floor) {
  const Svd svd = decompose(M);
  const Vec3 f = svd.S.unaryExpr(Filter(floor));
  return svd.V * f.asDiagonal() * svd.U.transpose();
}

// With M = U S V^T and D = U^T dM V, the odd spectral function changes by
//
//   d(U f V^T) = U (G o sym D + L o skew D) V^T + (I - U U^T) dM V (f/S) V^T,
//   G_kl = (f_k - f_l) / (s_k - s_l),   L_kl = (f_k + f_l) / (s_k + s_l),
//
// a linear map of dM that is its own adjoint.
FitMatrix fit_inverse_vjp(const FitMatrix& M, const FitInverse& inverse_bar, double floor) {
  const Filter filter(floor);
  const auto [U, s, V] = decompose(M);

  const FitMatrix bar_V = inverse_bar.transpose() * V;
  const Mat3 D = U.transpose() * bar_V;
  Mat3 inner;
  for (int k = 0; k < 3; ++k) {
    for (int l = 0; l < 3; ++l) {
      inner(k, l) = 0.5 * (filter.divided_difference(s(k), s(l)) * (D(k, l) + D(l, k)) +
                           filter.divided_difference(s(k), -s(l)) * (D(k, l) - D(l, k)));
    }
  }
  const Vec3 f_over_s = s.unaryExpr([&](double value) { return filter.over_s(value); });
  return (U * inner + (bar_V - U * D) * f_over_s.asDiagonal()) * V.transpose();
}

}  // namespace diffcloth::mesh
