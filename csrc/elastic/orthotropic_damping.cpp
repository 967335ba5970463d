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
