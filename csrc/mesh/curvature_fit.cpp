#include "mesh/curvature_fit.h"

#include <Eigen/SVD>

namespace diffcloth::mesh {
namespace {

using Svd = Eigen::JacobiSVD<FitMatrix>;

Svd decompose(const FitMatrix& M) { return Svd(M, Eigen::ComputeThinU | Eigen::ComputeThinV); }

constexpr double kFloor2 = kRankFloor * kRankFloor;
constexpr double kFloor8 = kFloor2 * kFloor2 * kFloor2 * kFloor2;

double power7(double s) { return s * s * s * s * s * s * s; }
double denominator(double s) { return s * power7(s) + kFloor8; }
double filtered_inverse(double s) { return power7(s) / denominator(s); }
double filtered_inverse_over_s(double s) { return s * s * s * s * s * s / denominator(s); }

/// (f(s) - f(t)) / (s - t), without cancellation; t -> -t gives (f(s) + f(t)) / (s + t).
double divided_difference(double s, double t) {
  double power_sum = 0.0;  // (s^7 - t^7) / (s - t)
  for (int i = 0; i < 7; ++i) {
    double term = 1.0;
    for (int j = 0; j < 6; ++j) term *= j < i ? s : t;
    power_sum += term;
  }
  return (kFloor8 * power_sum - power7(s) * power7(t)) / (denominator(s) * denominator(t));
}

}  // namespace

double smallest_singular_value(const FitMatrix& M) { return decompose(M).singularValues()(2); }

FitInverse fit_inverse(const FitMatrix& M) {
  const Svd svd = decompose(M);
  const Vec3 f = svd.singularValues().unaryExpr(&filtered_inverse);
  return svd.matrixV() * f.asDiagonal() * svd.matrixU().transpose();
}

// With M = U S V^T and D = U^T dM V, the odd spectral function changes by
//
//   d(U f V^T) = U (G o sym D + L o skew D) V^T + (I - U U^T) dM V (f/S) V^T,
//   G_kl = (f_k - f_l) / (s_k - s_l),   L_kl = (f_k + f_l) / (s_k + s_l),
//
// a linear map of dM that is its own adjoint.
FitMatrix fit_inverse_vjp(const FitMatrix& M, const FitInverse& inverse_bar) {
  const Svd svd = decompose(M);
  const FitMatrix U = svd.matrixU();
  const Mat3 V = svd.matrixV();
  const Vec3 s = svd.singularValues();

  const FitMatrix bar_V = inverse_bar.transpose() * V;
  const Mat3 D = U.transpose() * bar_V;
  Mat3 inner;
  for (int k = 0; k < 3; ++k) {
    for (int l = 0; l < 3; ++l) {
      inner(k, l) = 0.5 * (divided_difference(s(k), s(l)) * (D(k, l) + D(l, k)) +
                           divided_difference(s(k), -s(l)) * (D(k, l) - D(l, k)));
    }
  }
  const Vec3 f_over_s = s.unaryExpr(&filtered_inverse_over_s);
  return (U * inner + (bar_V - U * D) * f_over_s.asDiagonal()) * V.transpose();
}

}  // namespace diffcloth::mesh
