#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "elastic/anchors.h"
#include "elastic/constant_form.h"
#include "elastic/elastic.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// Which cotangents of an elastic model someone asks for; those of x_n, through damping, always count.
enum class Wanted : std::uint8_t { kNone, kMaterials, kMaterialsAndRest };

/// Stretch, bending and damping of all cloths as a potential. See elastic.h.
class ElasticPotential final : public Potential {
 public:
  /// @param model    prepared; outlives the potential
  /// @param slots    of its elements in the base pattern
  /// @param pattern  the base pattern
  /// @param wanted   what accumulate() keeps
  ElasticPotential(const Model& model,
                   const Slots& slots,
                   const linalg::BlockPattern& pattern,
                   Wanted wanted);

  double energy(const double* x) const override { return elastic::energy(model_, x); }
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void extrapolate(const double* x, const double* to) override {
    extrapolated_ = extrapolated_stresses(model_, x, to);
  }
  void add_extrapolation(const double* x,
                         Curvature curvature,
                         linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override {
    elastic::add_hessian_product(model_, x, z, y);
  }
  void add_held_product(const double* x, const double* z, double* y) const override {
    elastic::add_hessian_product(model_, *model_.held, x, z, y);
  }

  void accumulate(const double* x, const double* z) override;

  const Model& model() const { return model_; }
  const Slots& slots() const { return slots_; }
  Wanted wanted() const { return wanted_; }

  /// Zero until something is accumulated.
  Bar& bar();

  /// Swap what has been accumulated; an empty one is zero.
  void exchange(Bar& other) { std::swap(bar_, other); }

 private:
  const Model& model_;
  const Slots& slots_;
  Wanted wanted_;
  ConstantForm flat_bending_;
  mutable std::vector<double> change_;  ///< scratch
  Bar bar_;
  std::vector<Mat2> extrapolated_;  ///< [F] second stresses
};

/// Soft pins as a potential. See anchors.h.
class AnchorPotential final : public Potential {
 public:
  explicit AnchorPotential(Anchors anchors);

  double energy(const double* x) const override { return elastic::energy(anchors_, x); }
  double energy_change(const double* x, const double* to) const override {
    return elastic::energy_change(anchors_, x, to);
  }
  void add_gradient(const double* x, double* g) const override {
    elastic::add_gradient(anchors_, x, g);
  }
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* /*x*/, const double* z, double* y) const override {
    elastic::add_hessian_product(anchors_, z, y);
  }
  void accumulate(const double* x, const double* z) override;

  const Anchors& anchors() const { return anchors_; }

  std::vector<double> stiffness_bar;  ///< [A]
  std::vector<double> target_bar;     ///< [3 A]

 private:
  Anchors anchors_;
};

}  // namespace diffcloth::elastic
