#pragma once

#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic_potential.h"

namespace diffcloth::elastic {

/// The energy of an ElasticPotential for whoever evaluates it hundreds of times: flat bending goes by
/// its matrix, which is a tenth of the work.
class RepeatedElasticity final : public ElasticPotential {
 public:
  RepeatedElasticity(const Model& model, const Slots& slots, const linalg::BlockPattern& pattern)
      : ElasticPotential(model, slots, Wanted::kNone),
        flat_bending_(ConstantForm::of_flat_bending(model, pattern)),
        step_(3 * static_cast<std::size_t>(model.topology->vertex_count)) {}

  double energy_change(const double* x, const double* to) const override {
    for (std::size_t a = 0; a < step_.size(); ++a) step_[a] = to[a] - x[a];
    return elastic::energy_change(model(), x, to, Elements::kButFlat) +
           flat_bending_.energy_change(x, step_.data());
  }

  void add_gradient(const double* x, double* g) const override {
    elastic::add_gradient(model(), x, g, Elements::kButFlat);
    flat_bending_.add_product(x, g);
  }

 private:
  ConstantForm flat_bending_;
  mutable std::vector<double> step_;  // scratch
};

}  // namespace diffcloth::elastic
