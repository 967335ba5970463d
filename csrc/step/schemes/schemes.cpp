#include "step/schemes/schemes.h"

#include "step/schemes/coupled.h"
#include "step/schemes/projective.h"
#include "step/schemes/second_order.h"
#include "step/schemes/split.h"

namespace diffcloth::step {

const Scheme& find_scheme(SchemeKind kind, Integrator integrator) {
  static const Coupled coupled;
  static const SecondOrder second_order;
  static const Split split;
  static const Projective projective;
  switch (kind) {
    case SchemeKind::kCoupled:
      if (integrator == Integrator::kSecondOrder) return second_order;
      return coupled;
    case SchemeKind::kSplit:
      return split;
    case SchemeKind::kProjective:
      return projective;
  }
  __builtin_unreachable();
}

}  // namespace diffcloth::step
