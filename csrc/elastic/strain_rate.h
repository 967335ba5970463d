#pragma once

#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic.h"
#include "elastic/elastic_potential.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// The stiffness of a model against strain rates about a point u, as a quadratic form of the displacement
/// from x_n:
///
///   E(y) = 1/2 d^T S(u) d,   d = y - x_n,
///
///   z^T S(u) d = sum_faces <K sym(F_u^T F(z)), sym(F_u^T F(d))> + sum_elements D A <Y(z) Q, Y(d)>,
///
/// with K the stiffnesses of a face times its area, and the constant form of bending. It is positive
/// semi-definite, and the stretch in it does not resist rotations about u.
class StrainRate final : public Potential {
 public:
  /// @param elastic  potential of the model, to whose cotangents and tangents this one adds; outlives
  ///                 this
  /// @param pattern  the base pattern
  /// @param middle   u, at least for the cloths' vertices; outlives this
  /// @param start    x_n, likewise
  StrainRate(ElasticPotential& elastic,
             const linalg::BlockPattern& pattern,
             const double* middle,
             const double* start);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(middle_bar);
    store.exchange(start_bar);
  }

  std::vector<double> middle_bar, start_bar;  ///< [3 N]
  std::vector<double> middle_dot, start_dot;  ///< [3 N at least] tangents, for add_tangent()

 private:
  std::size_t size() const { return middle_bar.size(); }
  /// d, padded with zeros to the rows of the pattern.
  std::vector<double> displacement(const double* x) const;
  double product(const std::vector<double>& z, const std::vector<double>& d) const;
  /// S by the slots of the pattern, 9 numbers each.
  const std::vector<double>& blocks() const;

  ElasticPotential& elastic_;
  const Model& model_;
  const double* middle_;
  const double* start_;
  const linalg::BlockPattern& pattern_;
  mutable std::vector<double> blocks_;  ///< empty until first used
};

}  // namespace diffcloth::elastic
