#include "elastic/damping.h"

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::damping {
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
