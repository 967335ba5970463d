#pragma once

#include <vector>

#include "elastic/elastic_potential.h"
#include "step/step_potential.h"

namespace diffcloth::step {

/// The springs of soft pins: each between a vertex and its target.
class SoftPins final : public StepPotential {
 public:
  explicit SoftPins(const Problem& problem);

  elastic::SpringPotential& potential() override { return potential_; }
  void pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) override;
  void push_forward(const Problem& problem, const Tangents& tangents) override;
  void visit_energy(const double* x, const VisitEnergy& visit) const override;
  void accumulate_energy(const double* x, const Seed& seed, double* x_bar) override;

 private:
  std::vector<Index> start_;         ///< [Q + 1] 0, 1, 2 ..
  std::vector<double> coefficient_;  ///< [Q] ones
  std::vector<double> stiffness_;    ///< [Q]
  elastic::SpringPotential potential_;
};

}  // namespace diffcloth::step
