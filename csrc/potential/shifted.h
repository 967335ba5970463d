#pragma once

#include <vector>

#include "potential/potential.h"

namespace diffcloth {

/// Another potential at shifted points:  P(x - d).
///
/// Inputs and cotangents of P remain with P; its owner swaps the cotangents.
class Shifted final : public Potential {
 public:
  /// @param potential  P; must outlive this object
  /// @param shift      d, all points [m]; likewise
  Shifted(Potential& potential, const std::vector<double>& shift);

  void stand_at(const double* x) override { potential_.stand_at(less(x)); }
  double energy(const double* x) const override { return potential_.energy(less(x)); }
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override {
    potential_.add_gradient(less(x), g);
  }
  void add_couplings(std::vector<std::pair<Index, Index>>& pairs) const override {
    potential_.add_couplings(pairs);
  }
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override {
    potential_.add_hessian(less(x), curvature, A);
  }
  void extrapolate(const double* x, const double* to) override;
  void add_extrapolation(const double* x,
                         Curvature curvature,
                         linalg::BlockMatrix& A) const override {
    potential_.add_extrapolation(less(x), curvature, A);
  }
  void add_hessian_product(const double* x, const double* z, double* y) const override {
    potential_.add_hessian_product(less(x), z, y);
  }
  void add_hessian_products(const double* x, const Products& products) const override {
    potential_.add_hessian_products(less(x), products);
  }
  void add_held_product(const double* x, const double* z, double* y) const override {
    potential_.add_held_product(less(x), z, y);
  }
  void add_left_out_products(const double* x,
                             Curvature curvature,
                             const Products& products) const override {
    potential_.add_left_out_products(less(x), curvature, products);
  }
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override { store.exchange(shift_bar); }

  std::vector<double> shift_bar;  ///< [all points]; empty until accumulate()
  std::vector<double> shift_dot;  ///< likewise, for add_tangent(); empty: zero

 private:
  /// x - d; valid until the next call.
  const double* less(const double* x) const;

  Potential& potential_;
  const std::vector<double>& shift_;
  mutable std::vector<double> at_;  ///< scratch
};

}  // namespace diffcloth
