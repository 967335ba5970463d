#pragma once

#include <vector>

#include "bodies/joint_term.h"
#include "bodies/mechanisms.h"
#include "potential/potential.h"

namespace diffcloth::bodies {

/// Potential of the mechanisms' coordinates q:
///
///   sum over trees of 1/2 (q - t)^T A (q - t)  +  sum over limits of k b(u)  +  sum of joints' terms,
///
/// with all quadratic terms (inertia, drives, damping) in the metric A and the target t. A limit acts up
/// to the end of a zone beyond it, whose width w is `limit_zone` times the joint's range: u is the
/// distance left to the end, and
///
///   b(u) = -(u - w)^2 log(u / w),   0 for u >= w.
///
/// JointTerm defines the term of a joint. Its friction has a kink, across which Newton's method would
/// oscillate: it has duals, as friction of contacts has (contact/friction_set.h).
class CoordinatePotential final : public Potential {
 public:
  /// @param first_point  index of the first node among all points
  /// @param first_row    row of the first node in the linear system
  /// @param targets      t [n]
  /// @param metric       A, row by row, tree after tree [sum n_t^2]; only its symmetric part is used
  /// @param joints       rows of JointTerm [n]; null: none
  /// @param h            time step [s]
  CoordinatePotential(const Mechanisms& mechanisms,
                      Index first_point,
                      Index first_row,
                      const double* targets,
                      const double* metric,
                      const double* joints,
                      double h);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void update_duals(const double* x, const double* p, double alpha, const double* to) override;
  double force_change(const double* x, const double* p) const override;
  bool has_duals(const double* x) const override;
  /// True if a joint has a drive, friction or a limit. The forces of these terms have kinks.
  bool has_joint_terms() const { return joints_ != nullptr; }
  void swap_cotangents(CotangentStore& store) override {
    store.exchange(target_bar);
    store.exchange(metric_bar);
    store.exchange(joint_bar);
  }

  /// Value q of a coordinate, clamped to the middle of the zone beyond its speed limit.
  double within_speed(Index coordinate, double q) const;

  /// Largest fraction of the change dx that uses at most `share` of the distances left to the ends of
  /// the speed limits.
  double largest_fraction(const double* x, const double* dx, double share) const;

  /// Append the diagonal of A for each number of the nodes.
  void append_diagonal(std::vector<double>& out) const;

  std::vector<double> target_dot;  ///< [n] tangents, for add_tangent()
  std::vector<double> metric_dot;  ///< [sum n_t^2]
  std::vector<double> joint_dot;   ///< [n, columns]
  std::vector<double> target_bar;  ///< [n], zero until accumulate()
  std::vector<double> metric_bar;  ///< [sum n_t^2]
  std::vector<double> joint_bar;   ///< [n, columns]

 private:
  struct Tree {
    std::vector<Index> slot;  // slots of its coordinates among the numbers of the nodes
    Index first_coordinate;
    std::size_t metric;  // start of its block of A
    Index first_node, last_node;
    double fill;  // diagonal for numbers of nodes without a coordinate
  };

  double at(const Tree& tree, Index i, Index j) const {
    const std::size_t n = tree.slot.size();
    return 0.5 * (metric_[tree.metric + n * i + j] + metric_[tree.metric + n * j + i]);
  }
  /// Visit the limits of free joints: visit(slot, sign, u, w, k), where du/dq = -sign.
  template <class Visit>
  void visit_limits(const double* nodes, Visit&& visit) const;

  /// Visit the terms of free joints: visit(c, slot, term, constants).
  template <class Visit>
  void visit_joints(Visit&& visit) const;
  const double* nodes(const double* x) const {
    return x + 3 * static_cast<std::ptrdiff_t>(first_point_);
  }

  const Mechanisms& mechanisms_;
  Index first_point_;
  Index first_row_;
  const double* targets_;
  const double* metric_;
  const double* joints_;
  double h_;
  std::vector<Tree> trees_;
  std::vector<double> duals_;     // [n] directions of friction
  std::vector<double> duals_at_;  // numbers of the nodes for the duals; empty: no duals
};

}  // namespace diffcloth::bodies
