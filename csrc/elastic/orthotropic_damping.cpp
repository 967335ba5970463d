#include "elastic/orthotropic_damping.h"

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::orthotropic_damping {
namespace {

/// W(C - C_n).
Mat2 tension(const Weave& weave, const Mat32& F, const damping::Start& start) {
  return weave.times_in_rest_frame(damping::strain(F, start));
}

}  // namespace

Mat32 stress(const Weave& weave, const Mat32& F, const damping::Start& start) {
  return 0.5 * F * tension(weave, F, start);
}

Mat32 stress_change(const Weave& weave,
                    const Mat32& F,
                    const damping::Start& start,
                    const Mat32& G) {
  const Mat2 dC = 2.0 * symmetric_part(F.transpose() * G);
  return 0.5 * (G * tension(weave, F, start) + F * weave.times_in_rest_frame(dC));
}

Mat32 stress_change(const Weave& weave,
                    const Mat32& F,
                    const damping::Start& start,
                    const damping::Start& change) {
  return 0.5 * F * weave.times_in_rest_frame(damping::start_change(start, change));
}

damping::Start start_bar(const Weave& weave,
                         const Mat32& F,
                         const damping::Start& start,
                         const Mat32& G) {
  return damping::start_bar(start,
                            0.5 * weave.times_in_rest_frame(symmetric_part(F.transpose() * G)));
}

}  // namespace diffcloth::elastic::orthotropic_damping
