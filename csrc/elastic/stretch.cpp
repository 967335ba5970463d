#include "elastic/stretch.h"

#include <cmath>

namespace diffcloth::elastic::stretch {
namespace {

/// A symmetric 2x2 matrix with its eigenvalues clamped to at least 0.
Mat2 positive_part(const Mat2& A) {
  const double mean = 0.5 * (A(0, 0) + A(1, 1));
  const double half = 0.5 * (A(0, 0) - A(1, 1));
  const double radius = std::hypot(half, A(0, 1));
  if (mean - radius >= 0.0) return A;
  if (mean + radius <= 0.0) return Mat2::Zero();
  // Here radius > 0. A = mean I + D with D^2 = radius^2 I: rescale D about the clamped mean.
  const double high = mean + radius;
  Mat2 result = 0.5 * high / radius * (A - mean * Mat2::Identity());
  result.diagonal().array() += 0.5 * high;
  return result;
}

}  // namespace

double energy(double weight, const Mat32& F) {
  const Frame polar = frame(F);
  if (polar.d >= kNearlyDegenerate) {
    return 0.5 * weight * (F - polar.R.leftCols<2>()).squaredNorm();
  }
  return 0.5 * weight * (F.squaredNorm() - 2.0 * polar.t + 2.0);
}

Mat2 second_stress(double weight, const Mat32& F) {
  return weight * (Mat2::Identity() - frame(F).S_inv);
}

Mat2 extrapolated_stress(double weight, const Mat32& F, const Mat32& G) {
  // From F T = dE/dF:  F dT = d(dE/dF) - G T, and the left inverse of F is S^-1 R^T.
  const Frame polar = frame(F);
  const Mat2 T = second_stress(weight, F);
  const Mat32 F_dT = stress_change(weight, F, G) - G * T;
  const Mat2 dT = polar.S_inv * (polar.R.leftCols<2>().transpose() * F_dT);
  return T + 0.5 * (dT + dT.transpose());
}

std::array<Mat3, 6> extrapolation(double weight,
                                  const mesh::ShapeGradient& g,
                                  const Mat32& F,
                                  const Mat2& extrapolated,
                                  bool positive) {
  const Mat2 T = second_stress(weight, F);
  Mat2 dT = extrapolated - T;
  Mat3 along = Mat3::Identity();
  if (positive) {
    dT = positive_part(extrapolated) - positive_part(T);
    const Vec3 n = frame(F).R.col(2);
    along = n * n.transpose();
  }
  std::array<Mat3, 6> blocks;
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      blocks[k] = g.row(p).dot(dT * g.row(q).transpose()) * along;
    }
  }
  return blocks;
}

Mat32 stress_change(double weight, const Mat32& F, const Mat32& G) {
  const Frame polar = frame(F);
  const Vec3 w = rotation(polar, polar.R.transpose() * G);
  const Mat3 dR = polar.R * cross_matrix(w);
  return weight * (G - dR.leftCols<2>());
}

}  // namespace diffcloth::elastic::stretch
