#include "elastic/orthotropic_damping.h"

#include "elastic/damping.h"
#include "elastic/symmetric2.h"

namespace diffcloth::elastic::orthotropic_damping {
namespace {

/// W(C - C_n).
Mat2 tension(const Weave& weave, const Mat32& F, const Mat32& F_n) {
  return weave.times_in_rest_frame(damping::strain(F, F_n));
}

}  // namespace

Mat32 stress(const Weave& weave, const Mat32& F, const Mat32& F_n) {
  return 0.5 * F * tension(weave, F, F_n);
}

double energy_change(
    const Weave& weave, const Mat32& F0, const Mat32& F1, const Mat32& dF, const Mat32& F_n) {
  const Mat2 dC = dF.transpose() * F1 + F0.transpose() * dF;
  return (tension(weave, F0, F_n) + tension(weave, F1, F_n)).cwiseProduct(dC).sum() / 8.0;
}

std::array<Mat3, 6> hessian(const Weave& weave,
                            const mesh::ShapeGradient& g,
                            const Mat32& F,
                            const Mat32& F_n,
                            bool positive) {
  Mat2 W = symmetric_part(tension(weave, F, F_n));
  if (positive) W = positive_part(W);
  std::array<Mat3, 6> blocks;
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      const Vec2 g_p = g.row(p).transpose();
      const Vec2 g_q = g.row(q).transpose();
      Mat2 M;
      for (int i = 0; i < 2; ++i) {
        const Mat2 half = Vec2::Unit(i) * g_q.transpose();
        M.col(i) = weave.times_in_rest_frame(half + half.transpose()) * g_p;
      }
      blocks[k] = 0.5 * F * M * F.transpose();
      blocks[k].diagonal().array() += 0.5 * g_p.dot(W * g_q);
    }
  }
  return blocks;
}

Mat32 stress_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G) {
  const Mat2 dC = 2.0 * symmetric_part(F.transpose() * G);
  return 0.5 * (G * tension(weave, F, F_n) + F * weave.times_in_rest_frame(dC));
}

Mat32 start_change(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G_n) {
  return -F * weave.times_in_rest_frame(symmetric_part(F_n.transpose() * G_n));
}

Mat32 start_bar(const Weave& weave, const Mat32& F, const Mat32& F_n, const Mat32& G) {
  return -F_n * weave.times_in_rest_frame(symmetric_part(F.transpose() * G));
}

}  // namespace diffcloth::elastic::orthotropic_damping
