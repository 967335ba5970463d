#include "elastic/stretch.h"

namespace diffcloth::elastic::stretch {

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

Mat32 stress_change(double weight, const Mat32& F, const Mat32& G) {
  const Frame polar = frame(F);
  const Vec3 w = rotation(polar, polar.R.transpose() * G);
  const Mat3 dR = polar.R * cross_matrix(w);
  return weight * (G - dR.leftCols<2>());
}

}  // namespace diffcloth::elastic::stretch
