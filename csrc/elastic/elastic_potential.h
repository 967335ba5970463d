#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic.h"
#include "elastic/springs.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// Requested cotangents of an elastic model; the cotangents of x_n, through damping, are always
/// computed.
enum class Wanted : std::uint8_t { kNone, kMaterials, kMaterialsAndRest };

/// Stretch, bending and damping of all cloths as a potential. See elastic.h.
class ElasticPotential final : public Potential {
 public:
  /// @param model    prepared; outlives the potential
  /// @param slots    of its elements in the base pattern
  /// @param pattern  the base pattern
  /// @param wanted   cotangents that accumulate() keeps
  ElasticPotential(const Model& model,
                   const Slots& slots,
                   const linalg::BlockPattern& pattern,
                   Wanted wanted);

  /// Update the potential after the model was prepared again.
  void renew();

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
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override { store.exchange(bar_); }

  const Model& model() const { return model_; }
  const Slots& slots() const { return slots_; }
  Wanted wanted() const { return wanted_; }

  /// Zero until the first accumulate().
  Bar& bar();

  /// add_tangent() for the model's ConstantForm.
  void add_constant_form_tangent(const double* u, double* y) const {
    elastic::add_constant_form_tangent(model_, u, dot_, changing_, y);
  }

  /// Tangents of the model, for add_tangent().
  void set_tangent(Bar dot, Changing changing) {
    dot_ = std::move(dot);
    changing_ = changing;
  }
  const Bar& tangent() const { return dot_; }
  const Changing& changing() const { return changing_; }

  /// Set the tangent of the model's prediction, at least [3 N].
  void set_ahead_tangent(const std::vector<double>& ahead_dot);

 private:
  const Model& model_;
  const Slots& slots_;
  Wanted wanted_;
  ConstantForm flat_bending_;
  mutable std::vector<double> change_;  ///< scratch

  /// States of bending at one point.
  struct Known {
    std::vector<double> x;  ///< positions of the vertices; empty if nothing is known
    BendingStates bent;
  };
  /// States at x, which are kept until two other points are evaluated.
  const BendingStates& bent_at(const double* x) const;

  mutable std::array<Known, 2> known_;
  mutable std::size_t last_ = 0;  ///< index of the point that was asked for last

  /// Last point at which energy and gradient were evaluated: often the next iterate.
  struct Trial {
    std::vector<double> x;  ///< positions of the vertices; empty if nothing is known
    std::vector<double> gradient;
  };
  mutable Trial trial_;
  Bar bar_;                         ///< empty if zero
  std::vector<Mat2> extrapolated_;  ///< [F] second stresses
  Bar dot_;
  Changing changing_;
};

/// Springs between points as a potential. See springs.h.
class SpringPotential final : public Potential {
 public:
  /// @param springs       views of arrays that outlive the potential
  /// @param first_body    the first point that is not a vertex of a cloth
  /// @param target_count  rows of targets
  SpringPotential(Springs springs, Index first_body, Index target_count);

  double energy(const double* x) const override { return elastic::energy(springs_, x); }
  double energy_change(const double* x, const double* to) const override {
    return elastic::energy_change(springs_, x, to);
  }
  void add_gradient(const double* x, double* g) const override {
    elastic::add_gradient(springs_, x, g);
  }
  void add_couplings(std::vector<std::pair<Index, Index>>& pairs) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override {
    elastic::add_hessian_product(springs_, x, z, y);
  }
  void add_left_out_products(const double* x,
                             Curvature curvature,
                             const Products& products) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override {
    elastic::add_tangent(springs_, x, stiffness_dot.data(), target_dot.data(), y);
  }
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(stiffness_bar);
    store.exchange(target_bar);
  }

  const Springs& springs() const { return springs_; }

  std::vector<double> stiffness_bar;  ///< [A], cotangents of the weighted stiffnesses
  std::vector<double> target_bar;     ///< [rows of targets, 3]
  std::vector<double> stiffness_dot;  ///< tangents, for add_tangent()
  std::vector<double> target_dot;

 private:
  Springs springs_;
  Index first_body_;
};

}  // namespace diffcloth::elastic
