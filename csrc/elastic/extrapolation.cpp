#include "elastic/extrapolation.h"

#include "elastic/symmetric2.h"

namespace diffcloth::elastic {

Mat2 extrapolated_stress(const Mat32& F, const Mat32& G, const Mat2& T, const Mat32& dP) {
  // From F T = dE/dF:  F dT = d(dE/dF) - G T, and the left inverse of F is S^-1 R^T.
  const Frame polar = frame(F);
  const Mat32 F_dT = dP - G * T;
  const Mat2 dT = polar.S_inv * (polar.R.leftCols<2>().transpose() * F_dT);
  return T + 0.5 * (dT + dT.transpose());
}

std::array<Mat3, 6> extrapolation(const mesh::ShapeGradient& g,
                                  const Mat32& F,
                                  const Mat2& T,
                                  const Mat2& extrapolated,
                                  bool positive) {
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

}  // namespace diffcloth::elastic
