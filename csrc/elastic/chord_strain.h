#pragma once

#include <vector>

#include "elastic/elastic_potential.h"
#include "elastic/frame.h"
#include "elastic/stretch_lanes.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// Resistance to the strain that a displacement d adds to faces which a step turns:
///
///   E(x) = sum_faces k A phi(|e|^2),   e = sym(F(x - c)^T F(d)),   phi(q) = 1/2 q^2 / (q + q_0),
///
/// k the mean stiffness of a face, A its area. The strain of the faces at x is their strain at x - d
/// plus e, if the strain rate of d is zero at c - d / 2. E is convex; below strains of sqrt(q_0) it is
/// of fourth order, so that smooth motion does not feel it.
class ChordStrain final : public Potential {
 public:
  /// @param elastic  potential of the model, to whose cotangents and tangents this one adds; outlives
  ///                 this
  /// @param shift    d, at least for the cloths' vertices, from the first use on; outlives this
  /// @param center   c, likewise
  ChordStrain(ElasticPotential& elastic, const double* shift, const double* center);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(shift_bar);
    store.exchange(center_bar);
  }

  std::vector<double> shift_bar, center_bar;  ///< [3 N]
  std::vector<double> shift_dot, center_dot;  ///< [3 N at least] tangents, for add_tangent()

 private:
  struct Face;
  Face face(Index f, const double* x) const;
  const std::vector<ChordBatch>& batches() const;

  ElasticPotential& elastic_;
  const Model& model_;
  const double* shift_;
  const double* center_;
  mutable std::vector<ChordBatch> batches_;  ///< empty until first used
};

}  // namespace diffcloth::elastic
