#pragma once

#include <span>
#include <vector>

#include "elastic/elastic.h"
#include "elastic/springs.h"
#include "linalg/block_pattern.h"

namespace diffcloth::elastic {

/// The constant quadratic form of Projective Dynamics (Bouaziz et al. 2014, Eq. 10; the paper's Sec.
/// III.B), one scalar matrix L for all three axes:
///
///   1/2 u^T L u = sum_faces    k_s A / 2 (1 + k_d/h) |F(u)|^2
///               + sum_elements D A / 2 (1 + k_d/h) <Y(u) Q, Y(u)>
///               + sum_springs  k_a / 2 |sum_p b_p u_p|^2,
///
/// F(u) the gradient of a displacement u and Y(u) its second derivatives. The form is the Hessian of the
/// energy of all cloths without the terms from turning triangles: no smaller than the Hessian of the
/// stretch, equal to the Hessian for flat bending and for springs without a rest length, and no smaller
/// for other springs. For damping, for curved rest shapes and for woven cloth whose shear is stiffer
/// than a yarn, it is a positive matrix of the right size, which suffices for a solve.
///
/// Springs act on their points on cloths alone: bodies do not move. Without springs to targets or
/// bodies, L annihilates constants. Entries act on differences of displacements, so that the forces on
/// two vertices are opposite to the last bit.
class ConstantForm {
 public:
  /// @param model    prepared
  /// @param pattern  pattern of the slots; outlives the form
  ConstantForm(const Model& model,
               const Slots& slots,
               std::span<const Springs> springs,
               const linalg::BlockPattern& pattern);

  /// The form of flat bending alone, which is its energy; the model keeps the values.
  static ConstantForm of_flat_bending(const Model& model, const linalg::BlockPattern& pattern);

  /// The form of all bending without damping, as if every element were flat.
  static ConstantForm of_bending(const Model& model,
                                 const Slots& slots,
                                 const linalg::BlockPattern& pattern);

  ConstantForm(const ConstantForm&) = delete;
  ConstantForm& operator=(const ConstantForm&) = delete;
  ConstantForm(ConstantForm&&) = default;
  ConstantForm& operator=(ConstantForm&&) = default;

  /// L, one value a slot of the pattern [N/m].
  std::span<const double> values() const { return values_; }
  const linalg::BlockPattern& pattern() const { return *pattern_; }

  /// 1/2 (u + s)^T L (u + s) - 1/2 u^T L u  [J].
  double energy_change(const double* u, const double* s) const;

  /// y += L u.
  void add_product(const double* u, double* y) const;

 private:
  ConstantForm(const linalg::BlockPattern& pattern, Index vertices, std::span<const double> values)
      : pattern_(&pattern), vertex_count_(vertices), values_(values) {}

  const linalg::BlockPattern* pattern_;
  Index vertex_count_;  ///< the pattern may have further rows
  std::vector<double> own_values_;
  std::span<const double> values_;
  void add_spring(const Springs& springs, Index a);

  std::vector<Index> anchor_vertex_;      ///< vertices with springs to fixed points
  std::vector<double> anchor_stiffness_;  ///< likewise
};

/// bar += d/d theta (z . L u) for each theta of the model, springs not included.
///
/// @param with_rest  true to compute the cotangents of the rest shape
void add_constant_form_mixed(
    const Model& model, const double* u, const double* z, bool with_rest, Bar& bar);

/// y += d/d theta (L u) theta_dot, springs not included: add_constant_form_mixed(), transposed.
void add_constant_form_tangent(
    const Model& model, const double* u, const Bar& dot, const Changing& changing, double* y);

/// Mixed derivative and tangent, as above, of ConstantForm::of_bending().
void add_bending_form_mixed(
    const Model& model, const double* u, const double* z, bool with_rest, Bar& bar);
void add_bending_form_tangent(
    const Model& model, const double* u, const Bar& dot, const Changing& changing, double* y);

}  // namespace diffcloth::elastic
