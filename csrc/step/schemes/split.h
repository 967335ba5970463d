#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// The paper's scheme (Eqs. 21-29): first inertia + elasticity + anchors without contact, with the
/// solution x^D; then 1/(2h^2) (x - x^D)^T G (x - x^D) + barrier + friction.
class Split final : public Scheme {
 public:
  std::vector<Field> tape(const Scene& scene) const override;
  void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const override;
  void backward(const Backward& step) const override;
  std::vector<std::vector<double>> tangent(const Pushforward& step) const override;
};

}  // namespace diffcloth::step
