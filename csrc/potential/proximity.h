#pragma once

#include <vector>

#include "potential/potential.h"

namespace diffcloth {

/// Quadratic distance to a target in a diagonal metric:  P = 1/(2 h^2) (x - y)^T G (x - y).
///
/// With G the lumped masses and y the inertial prediction it is the inertia potential of implicit Euler.
class Proximity final : public Potential {
 public:
  /// @param metric  G_i [kg], one a cloth vertex
  /// @param target  y [m], [3 N]
  Proximity(std::vector<double> metric, std::vector<double> target, double h);

  const std::vector<double>& metric() const { return metric_; }
  const std::vector<double>& target() const { return target_; }

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(metric_bar);
    store.exchange(target_bar);
  }

  std::vector<double> metric_bar;  ///< [N], zero until accumulate()
  std::vector<double> target_bar;  ///< [3 N]

  std::vector<double> metric_dot;  ///< [N] tangent, for add_tangent()
  std::vector<double> target_dot;  ///< [3 N]

 private:
  Index size() const { return static_cast<Index>(metric_.size()); }

  std::vector<double> metric_;
  std::vector<double> target_;
  double inv_h_sq_;
};

}  // namespace diffcloth
