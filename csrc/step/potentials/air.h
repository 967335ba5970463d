#pragma once

#include <vector>

#include "air/drag_potential.h"
#include "step/step_potential.h"

namespace diffcloth::step {

/// Drag and lift of the faces of cloths: a = rho C_n / 2 and b = rho C_t / 2, with the density rho of the
/// air and the coefficients C_n across and C_t along the faces. See air/drag_potential.h.
class Air final : public StepPotential {
 public:
  /// @param wanted  requested gradients; null: none
  Air(const Problem& problem, const Gradients* wanted);

  air::DragPotential& potential() override { return potential_; }
  void pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) override;
  void push_forward(const Problem& problem, const Tangents& tangents) override;

 private:
  double half_density_;             ///< rho / 2
  std::vector<double> normal_;      ///< [F] C_n
  std::vector<double> tangential_;  ///< [F] C_t
  air::DragPotential potential_;
};

}  // namespace diffcloth::step
