#include "elastic/stretch.h"

#include <algorithm>
#include <cmath>

namespace diffcloth::elastic::stretch {
namespace {

/// Area ratio below which a frame need not be orthonormal to rounding.
constexpr double kNearlyDegenerate = 1e-4;

/// A symmetric 2x2 matrix with its eigenvalues clamped to at most top.
Mat2 clamp(const Mat2& A, double top) {
  const double mean = 0.5 * (A(0, 0) + A(1, 1));
  const double half = 0.5 * (A(0, 0) - A(1, 1));
  const double radius = std::hypot(half, A(0, 1));
  if (mean + radius <= top) return A;
  if (mean - radius >= top) return top * Mat2::Identity();
  // Here radius > 0. A = mean I + D with D^2 = radius^2 I: rescale D about the clamped mean.
  const double low = mean - radius;
  const double scale = 0.5 * (top - low) / radius;
  Mat2 result = scale * (A - mean * Mat2::Identity());
  result.diagonal().array() += 0.5 * (top + low);
  return result;
}

/// The positive part of a symmetric 2x2 matrix.
Mat2 positive_part(const Mat2& A) { return -clamp(-A, 0.0); }

}  // namespace

double energy(double weight, const Mat32& F) {
  const Frame polar = frame(F);
  if (polar.d >= kNearlyDegenerate) {
    return 0.5 * weight * (F - polar.R.leftCols<2>()).squaredNorm();
  }
  return 0.5 * weight * (F.squaredNorm() - 2.0 * polar.t + 2.0);
}

double energy_change(double weight, const Mat32& F0, const Mat32& F1, const Mat32& dF) {
  const Frame frame0 = frame(F0);
  const Frame frame1 = frame(F1);
  if (std::min(frame0.d, frame1.d) < kNearlyDegenerate) {
    return energy(weight, F1) - energy(weight, F0);
  }
  const Mat32 R0 = frame0.R.leftCols<2>();
  const Mat32 R1 = frame1.R.leftCols<2>();
  const Mat32 dR = R1 - R0;
  const Mat2 dS = stretch_tensor(F1, frame1) - stretch_tensor(F0, frame0);
  const double work = ((F0 - R0) + (F1 - R1)).cwiseProduct(dF).sum();
  return 0.5 * weight * (work - 0.5 * dS.cwiseProduct(dR.transpose() * dR).sum());
}

std::array<Mat3, 6> hessian(double weight,
                            const mesh::ShapeGradient& g,
                            const Mat32& F,
                            bool positive) {
  const Frame polar = frame(F);
  const double t_inv = positive ? std::min(1.0 / polar.t, 0.5) : 1.0 / polar.t;
  const Mat2 S_inv = positive ? clamp(polar.S_inv, 1.0) : polar.S_inv;
  const Vec3 r1 = polar.R.col(0);
  const Vec3 r2 = polar.R.col(1);
  const Mat3 nn = polar.R.col(2) * polar.R.col(2).transpose();

  std::array<Vec3, 3> e;
  for (int p = 0; p < 3; ++p) e[p] = g(p, 0) * r2 - g(p, 1) * r1;
  std::array<Mat3, 6> blocks;
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      const double normal = g.row(p).dot(S_inv * g.row(q).transpose());
      blocks[k].noalias() = (-weight * t_inv) * e[p] * e[q].transpose();
      blocks[k] -= (weight * normal) * nn;
      blocks[k].diagonal().array() += weight * g.row(p).dot(g.row(q));
    }
  }
  return blocks;
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
