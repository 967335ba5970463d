#pragma once

#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic_potential.h"

namespace diffcloth::elastic {

/// Nearness to a target in the constant form of the elastic energy,  P = 1/2 (x - y)^T L (x - y).
///
/// Together with nearness in the masses, it is the nearness in G = M + h^2 L: see
/// step/schemes/split.cpp. L has the parameters of the elastic potentials, which keep the cotangents for
/// both.
class ElasticNearness final : public Potential {
 public:
  /// @param elasticity  of the cloths; outlives this potential, as do the springs
  /// @param target      y [3 N]
  ElasticNearness(ConstantForm form,
                  ElasticPotential& elasticity,
                  std::vector<SpringPotential*> springs,
                  std::vector<double> target);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override { store.exchange(target_bar); }

  std::vector<double> target_bar;  ///< [3 N], zero until accumulate()
  std::vector<double> target_dot;  ///< [3 N] tangent, for add_tangent(); others: the potentials

 private:
  /// u = x - y [3 N].
  std::vector<double> offset(const double* x) const;

  ConstantForm form_;
  ElasticPotential& elasticity_;
  std::vector<SpringPotential*> springs_;
  std::vector<double> target_;
};

}  // namespace diffcloth::elastic
