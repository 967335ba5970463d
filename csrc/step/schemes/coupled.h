#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// Inertia, all potentials of the cloths, barrier and friction, minimized together: one exact implicit Euler
/// step in contact.
class Coupled final : public Scheme {
 public:
  std::vector<Field> tape(const Scene& scene) const override;
  void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const override;
  void backward(const Backward& step) const override;
  std::vector<std::vector<double>> tangent(const Pushforward& step) const override;
};

}  // namespace diffcloth::step
