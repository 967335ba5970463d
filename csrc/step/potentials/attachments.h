#pragma once

#include <vector>

#include "elastic/elastic_potential.h"
#include "step/step_potential.h"

namespace diffcloth::step {

/// The springs of attachments between points of cloths and bodies, or to targets:
///
///   E = sum_a w_a k_a / 2 (|d_a| - L_a)^2,
///
/// with weights w and stiffnesses k of their own: see elastic/springs.h.
class Attachments final : public StepPotential {
 public:
  explicit Attachments(const Problem& problem);

  elastic::SpringPotential& potential() override { return potential_; }
  void pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) override;
  void push_forward(const Problem& problem, const Tangents& tangents) override;
  void visit_energy(const double* x, const VisitEnergy& visit) const override;
  void accumulate_energy(const double* x, const Seed& seed, double* x_bar) override;

 private:
  std::vector<double> stiffness_;  ///< [A] w k
  elastic::SpringPotential potential_;
};

}  // namespace diffcloth::step
