#include "elastic/damping.h"

#include <cmath>

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::damping {
namespace {

/// The positive semi-definite part of a symmetric 2x2 matrix.
Mat2 positive_part(const Mat2& A) {
  const double mean = 0.5 * (A(0, 0) + A(1, 1));
  const double radius = std::hypot(0.5 * (A(0, 0) - A(1, 1)), A(0, 1));
  if (mean - radius >= 0.0) return A;
  if (mean + radius <= 0.0) return Mat2::Zero();
  // Here radius > 0; only the eigenvalue mean + radius is left.
  const Mat2 projector = 0.5 * (Mat2::Identity() + (A - mean * Mat2::Identity()) / radius);
  return (mean + radius) * projector;
}

}  // namespace

double energy_change(
    double weight, const Mat32& F0, const Mat32& F1, const Mat32& dF, const Mat32& F_n) {
  const Mat2 dC = dF.transpose() * F1 + F0.transpose() * dF;
  return weight / 8.0 * (strain(F0, F_n) + strain(F1, F_n)).cwiseProduct(dC).sum();
}

std::array<Mat3, 6> hessian(
    double weight, const mesh::ShapeGradient& g, const Mat32& F, const Mat32& F_n, bool positive) {
  const Mat2 E = positive ? positive_part(strain(F, F_n)) : strain(F, F_n);
  const Mat3 FF = F * F.transpose();
  const double half = 0.5 * weight;
  std::array<Vec3, 3> Fg;
  for (int p = 0; p < 3; ++p) Fg[p] = F * g.row(p).transpose();
  std::array<Mat3, 6> blocks;
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      blocks[k].noalias() = half * Fg[q] * Fg[p].transpose();
      blocks[k] += (half * g.row(p).dot(g.row(q))) * FF;
      blocks[k].diagonal().array() += half * g.row(p).dot(E * g.row(q).transpose());
    }
  }
  return blocks;
}

Mat32 stress_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G) {
  const Mat2 dC = 2.0 * symmetric_part(F.transpose() * G);
  return 0.5 * weight * (G * strain(F, F_n) + F * dC);
}

Mat32 start_change(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G_n) {
  return -weight * F * symmetric_part(F_n.transpose() * G_n);
}

Mat32 start_bar(double weight, const Mat32& F, const Mat32& F_n, const Mat32& G) {
  return -weight * F_n * symmetric_part(F.transpose() * G);
}

}  // namespace diffcloth::elastic::damping
