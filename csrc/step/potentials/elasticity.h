#pragma once

#include "elastic/elastic.h"
#include "elastic/elastic_potential.h"
#include "step/step_potential.h"

namespace diffcloth::step {

/// Stretch, bending and damping of the cloths.
class Elasticity final : public StepPotential {
 public:
  /// @param wanted  requested gradients; null: none
  Elasticity(const Problem& problem, const Gradients* wanted);

  elastic::ElasticPotential& potential() override { return potential_; }
  void pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) override;
  void push_forward(const Problem& problem, const Tangents& tangents) override;
  void visit_energy(const double* x, const VisitEnergy& visit) const override;
  void accumulate_energy(const double* x, const Seed& seed, double* x_bar) override;

  const elastic::Model& model() const { return model_; }

  /// Set the prediction of a step of second order: damping then resists the mean of the predicted rate
  /// and the rate of the step, see elastic/damping.h.
  ///
  /// @param end  prediction of the end of the step [N, 3] [m]; outlives this object
  void predict(const Problem& problem, const double* end);

 private:
  elastic::Model model_;
  elastic::ElasticPotential potential_;
};

}  // namespace diffcloth::step
