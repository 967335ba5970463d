#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// The baseline of the paper (Sec. III.A): inertia + elasticity + anchors with dry frictional contact at
/// nodes, and no barrier. Surfaces may cross between nodes.
class Projective final : public Scheme {
 public:
  std::vector<Field> tape(const Scene& scene) const override;
  void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const override;
  void backward(const Backward& step) const override;
  std::vector<std::vector<double>> tangent(const Pushforward& step) const override;
};

}  // namespace diffcloth::step
