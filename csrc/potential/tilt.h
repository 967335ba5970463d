#pragma once

#include <utility>
#include <vector>

#include "potential/potential.h"

namespace diffcloth {

/// A constant force f on the cloths' vertices:  P = -f^T x.
class Tilt final : public Potential {
 public:
  /// @param force  f [N], [3 N]
  explicit Tilt(std::vector<double> force)
      : force_bar(force.size(), 0.0), force_(std::move(force)) {}

  double energy(const double* x) const override {
    const std::vector<double> origin(force_.size(), 0.0);
    return energy_change(origin.data(), x);
  }

  double energy_change(const double* x, const double* to) const override {
    double change = 0.0;
    for (std::size_t a = 0; a < force_.size(); ++a) change -= force_[a] * (to[a] - x[a]);
    return change;
  }

  void add_gradient(const double* /*x*/, double* g) const override {
    for (std::size_t a = 0; a < force_.size(); ++a) g[a] -= force_[a];
  }

  void add_hessian(const double* /*x*/,
                   Curvature /*c*/,
                   linalg::BlockMatrix& /*A*/) const override {}

  void add_hessian_product(const double* /*x*/, const double* /*z*/, double* /*y*/) const override {
  }

  void accumulate(const double* /*x*/, const double* z) override {
    for (std::size_t a = 0; a < force_.size(); ++a) force_bar[a] += z[a];
  }

  void add_tangent(const double* /*x*/, double* y) const override {
    for (std::size_t a = 0; a < force_dot.size(); ++a) y[a] -= force_dot[a];
  }

  void swap_cotangents(CotangentStore& store) override { store.exchange(force_bar); }

  std::vector<double> force_bar;  ///< [3 N], zero until accumulate()
  std::vector<double> force_dot;  ///< [3 N] tangent, for add_tangent()

 private:
  std::vector<double> force_;
};

}  // namespace diffcloth
