#include "elastic/damping.h"

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::damping {

Mat2 start_change(const Start& start, const Start& change) {
  const double of_n = -2.0 * (1.0 + start.ahead);
  Mat2 result = of_n * symmetric_part(start.F_n.transpose() * change.F_n);
  if (start.ahead != 0.0) {
    result += 2.0 * start.ahead * symmetric_part(start.F_a.transpose() * change.F_a);
  }
  return result;
}

Start start_bar(const Start& start, const Mat2& bar) {
  Start result{.F_n = -2.0 * (1.0 + start.ahead) * start.F_n * bar,
               .F_a = Mat32::Zero(),
               .ahead = start.ahead};
  if (start.ahead != 0.0) result.F_a = 2.0 * start.ahead * start.F_a * bar;
  return result;
}

Mat32 stress_change(double weight, const Mat32& F, const Start& start, const Mat32& G) {
  const Mat2 dC = 2.0 * symmetric_part(F.transpose() * G);
  return 0.5 * weight * (G * strain(F, start) + F * dC);
}

Start start_bar(double weight, const Mat32& F, const Start& start, const Mat32& G) {
  return start_bar(start, 0.5 * weight * symmetric_part(F.transpose() * G));
}

}  // namespace diffcloth::elastic::damping
