#pragma once

#include <vector>

#include "elastic/elastic_potential.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// The stiffness of springs against the rates of their lengths about a point u, as a quadratic form of the
/// displacement from x_n:
///
///   E(y) = 1/2 sum_a k_a r_a^T P_a r_a,   r_a = sum_p b_p (y_p - x_n,p),
///
/// P = n n^T along the spring at u, or I if its rest length is zero. Targets are treated as fixed.
class SpringRate final : public Potential {
 public:
  /// @param potential  of the springs, to whose cotangents and tangents this one adds; outlives this
  /// @param middle     u, all points; likewise
  /// @param start      x_n, likewise
  SpringRate(SpringPotential& potential,
             const std::vector<double>& middle,
             const std::vector<double>& start);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void add_left_out_products(const double* x,
                             Curvature curvature,
                             const Products& products) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(middle_bar);
    store.exchange(start_bar);
  }

  std::vector<double> middle_bar, start_bar;  ///< [all points]
  std::vector<double> middle_dot, start_dot;  ///< likewise, tangents for add_tangent()

 private:
  std::vector<double> displacement(const double* x) const;
  /// P r.
  Vec3 projected(Index a, const Vec3& r) const;
  Mat3 core(Index a) const;

  SpringPotential& potential_;
  const Springs& springs_;
  const std::vector<double>& middle_;
  const std::vector<double>& start_;
};

}  // namespace diffcloth::elastic
