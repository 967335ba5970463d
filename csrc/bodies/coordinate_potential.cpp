#include "bodies/coordinate_potential.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace diffcloth::bodies {
namespace {

/// Duals are dropped if all differ from the direction of friction by at most this.
constexpr double kClose = 0.1;

}  // namespace

CoordinatePotential::CoordinatePotential(const Mechanisms& mechanisms,
                                         Index first_point,
                                         Index first_row,
                                         const double* targets,
                                         const double* metric,
                                         const double* joints,
                                         double h)
    : target_bar(static_cast<std::size_t>(mechanisms.coordinate_count()), 0.0),
      joint_bar(joints == nullptr ? 0 : kJointColumns * target_bar.size(), 0.0),
      mechanisms_(mechanisms),
      first_point_(first_point),
      first_row_(first_row),
      targets_(targets),
      metric_(metric),
      joints_(joints),
      h_(h) {
  const std::vector<Index>& owner = mechanisms.given().coordinate_tree;
  std::size_t offset = 0;
  for (std::size_t first = 0; first < owner.size();) {
    Tree tree{.slot = {},
              .first_coordinate = static_cast<Index>(first),
              .metric = offset,
              .first_node = std::numeric_limits<Index>::max(),
              .last_node = 0,
              .fill = 0.0};
    std::size_t c = first;
    for (; c < owner.size() && owner[c] == owner[first]; ++c) {
      tree.slot.push_back(mechanisms.slot(static_cast<Index>(c)));
      tree.first_node = std::min(tree.first_node, tree.slot.back() / 3);
      tree.last_node = std::max(tree.last_node, tree.slot.back() / 3 + 1);
    }
    for (std::size_t i = 0; i < tree.slot.size(); ++i) {
      tree.fill = std::max(tree.fill, at(tree, static_cast<Index>(i), static_cast<Index>(i)));
    }
    offset += tree.slot.size() * tree.slot.size();
    first = c;
    trees_.push_back(std::move(tree));
  }
  metric_bar.assign(offset, 0.0);
}

template <class Visit>
void CoordinatePotential::visit_limits(const double* nodes, Visit&& visit) const {
  const MechanismsDescription& given = mechanisms_.given();
  for (Index c = 0; c < mechanisms_.coordinate_count(); ++c) {
    if (given.prescribed[c] != 0) continue;
    const double q = nodes[mechanisms_.slot(c)];
    const double w = given.limit_zone * (given.upper[c] - given.lower[c]);
    if (!std::isfinite(w)) continue;
    visit(mechanisms_.slot(c), 1.0, given.upper[c] + w - q, w, given.limit_stiffness[c]);
    visit(mechanisms_.slot(c), -1.0, q - given.lower[c] + w, w, given.limit_stiffness[c]);
  }
}

template <class Visit>
void CoordinatePotential::visit_joints(Visit&& visit) const {
  if (joints_ == nullptr) return;
  const MechanismsDescription& given = mechanisms_.given();
  for (Index c = 0; c < mechanisms_.coordinate_count(); ++c) {
    if (given.prescribed[c] != 0) continue;
    const double* const row = joints_ + static_cast<std::ptrdiff_t>(kJointColumns) * c;
    visit(c, mechanisms_.slot(c), joint_term(row),
          JointConstants{.h = h_,
                         .zone = given.limit_zone,
                         .velocity_stiffness = given.velocity_stiffness[c],
                         .velocity_force = given.velocity_force[c]});
  }
}

double CoordinatePotential::energy(const double* x) const {
  const double* nodes = x + 3 * static_cast<std::ptrdiff_t>(first_point_);
  double e = 0.0;
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < n; ++j) {
        e += 0.5 * at(tree, i, j) * (nodes[tree.slot[i]] - targets_[tree.first_coordinate + i]) *
             (nodes[tree.slot[j]] - targets_[tree.first_coordinate + j]);
      }
    }
  }
  visit_limits(nodes,
               [&](Index, double, double u, double w, double k) { e += k * limit_barrier(u, w); });
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    e += joint_energy_change(term, constants, term.origin, nodes[slot]);
  });
  return e;
}

double CoordinatePotential::energy_change(const double* x, const double* to) const {
  const double* from_nodes = x + 3 * static_cast<std::ptrdiff_t>(first_point_);
  const double* to_nodes = to + 3 * static_cast<std::ptrdiff_t>(first_point_);
  double change = 0.0;
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      const double step = to_nodes[tree.slot[i]] - from_nodes[tree.slot[i]];
      for (Index j = 0; j < n; ++j) {
        const double t = targets_[tree.first_coordinate + j];
        change += 0.5 * at(tree, i, j) * step *
                  ((from_nodes[tree.slot[j]] - t) + (to_nodes[tree.slot[j]] - t));
      }
    }
  }
  visit_limits(from_nodes, [&](Index, double, double u, double w, double k) {
    change -= k * limit_barrier(u, w);
  });
  visit_limits(to_nodes, [&](Index, double, double u, double w, double k) {
    change += k * limit_barrier(u, w);
  });
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    change += joint_energy_change(term, constants, from_nodes[slot], to_nodes[slot]);
  });
  return change;
}

void CoordinatePotential::add_gradient(const double* x, double* g) const {
  const double* nodes = x + 3 * static_cast<std::ptrdiff_t>(first_point_);
  double* out = g + 3 * static_cast<std::ptrdiff_t>(first_point_);
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < n; ++j) {
        out[tree.slot[i]] +=
            at(tree, i, j) * (nodes[tree.slot[j]] - targets_[tree.first_coordinate + j]);
      }
    }
  }
  visit_limits(nodes, [&](Index slot, double sign, double u, double w, double k) {
    if (u < w) out[slot] -= sign * k * limit_slope(u, w);
  });
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    out[slot] += joint_force(term, constants, nodes[slot]).slope;
  });
}

void CoordinatePotential::add_hessian(const double* x,
                                      Curvature curvature,
                                      linalg::BlockMatrix& A) const {
  const double* nodes = x + 3 * static_cast<std::ptrdiff_t>(first_point_);
  for (const Tree& tree : trees_) {
    const Index first = 3 * tree.first_node;
    const Index size = 3 * tree.last_node - first;
    Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(size, size);
    dense.diagonal().setConstant(tree.fill);
    for (const Index slot : tree.slot) dense(slot - first, slot - first) = 0.0;
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < n; ++j) {
        dense(tree.slot[i] - first, tree.slot[j] - first) += at(tree, i, j);
      }
    }
    for (Index i = tree.first_node; i < tree.last_node; ++i) {
      for (Index j = tree.first_node; j <= i; ++j) {
        A.add_block(first_row_ + i, first_row_ + j,
                    dense.block<3, 3>(3 * i - first, 3 * j - first));
      }
    }
  }
  // The barrier is convex: it equals its positive part.
  visit_limits(nodes, [&](Index slot, double, double u, double w, double k) {
    if (!(u < w)) return;
    Vec3 diagonal = Vec3::Zero();
    diagonal[slot % 3] = k * limit_curvature(u, w);
    A.add_to_diagonal(first_row_ + slot / 3, diagonal);
  });
  const bool dual = curvature == Curvature::kPrimalDual && has_duals(x);
  visit_joints([&](Index c, Index slot, const JointTerm& term, const JointConstants& constants) {
    const JointForce f = joint_force(term, constants, nodes[slot]);
    double value = f.sticking + std::max(f.curvature, 0.0);
    if (curvature != Curvature::kPositive) {
      value = f.sticking + f.turning * (dual ? duals_[c] : f.friction) + f.curvature;
    }
    if (value == 0.0) return;
    Vec3 diagonal = Vec3::Zero();
    diagonal[slot % 3] = value;
    A.add_to_diagonal(first_row_ + slot / 3, diagonal);
  });
}

void CoordinatePotential::add_hessian_product(const double* x, const double* z, double* y) const {
  const std::ptrdiff_t offset = 3 * static_cast<std::ptrdiff_t>(first_point_);
  const double* in = z + offset;
  double* out = y + offset;
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < n; ++j) out[tree.slot[i]] += at(tree, i, j) * in[tree.slot[j]];
    }
  }
  visit_limits(x + offset, [&](Index slot, double, double u, double w, double k) {
    if (u < w) out[slot] += k * limit_curvature(u, w) * in[slot];
  });
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    const JointForce f = joint_force(term, constants, (x + offset)[slot]);
    out[slot] += (f.sticking + f.turning * f.friction + f.curvature) * in[slot];
  });
}

void CoordinatePotential::accumulate(const double* x, const double* z) {
  const std::ptrdiff_t offset = 3 * static_cast<std::ptrdiff_t>(first_point_);
  const double* nodes = x + offset;
  const double* in = z + offset;
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    for (Index i = 0; i < n; ++i) {
      const double step_i = nodes[tree.slot[i]] - targets_[tree.first_coordinate + i];
      for (Index j = 0; j < n; ++j) {
        const double step_j = nodes[tree.slot[j]] - targets_[tree.first_coordinate + j];
        target_bar[tree.first_coordinate + i] += at(tree, i, j) * in[tree.slot[j]];
        metric_bar[tree.metric + static_cast<std::size_t>(n) * i + j] -=
            0.5 * (in[tree.slot[i]] * step_j + in[tree.slot[j]] * step_i);
      }
    }
  }
  visit_joints([&](Index c, Index slot, const JointTerm& term, const JointConstants& constants) {
    const JointRow by = joint_force(term, constants, nodes[slot]).by;
    double* const bar = joint_bar.data() + static_cast<std::ptrdiff_t>(kJointColumns) * c;
    for (int k = 0; k < kJointColumns; ++k) bar[k] -= by[k] * in[slot];
  });
}

void CoordinatePotential::add_tangent(const double* x, double* y) const {
  const std::ptrdiff_t offset = 3 * static_cast<std::ptrdiff_t>(first_point_);
  const double* nodes = x + offset;
  double* out = y + offset;
  for (const Tree& tree : trees_) {
    const auto n = static_cast<Index>(tree.slot.size());
    const double* const change = metric_dot.data() + tree.metric;
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j < n; ++j) {
        const std::ptrdiff_t row = static_cast<std::ptrdiff_t>(n) * i + j;
        const std::ptrdiff_t column = static_cast<std::ptrdiff_t>(n) * j + i;
        const double step = nodes[tree.slot[j]] - targets_[tree.first_coordinate + j];
        out[tree.slot[i]] += 0.5 * (change[row] + change[column]) * step -
                             at(tree, i, j) * target_dot[tree.first_coordinate + j];
      }
    }
  }
  visit_joints([&](Index c, Index slot, const JointTerm& term, const JointConstants& constants) {
    const JointRow by = joint_force(term, constants, nodes[slot]).by;
    const double* const dot = joint_dot.data() + static_cast<std::ptrdiff_t>(kJointColumns) * c;
    for (int k = 0; k < kJointColumns; ++k) out[slot] += by[k] * dot[k];
  });
}

void CoordinatePotential::update_duals(const double* x,
                                       const double* p,
                                       double alpha,
                                       const double* to) {
  if (joints_ == nullptr) return;
  const bool go_on = has_duals(x);
  std::vector<double> duals(static_cast<std::size_t>(mechanisms_.coordinate_count()), 0.0);
  bool any = false;
  visit_joints([&](Index c, Index slot, const JointTerm& term, const JointConstants& constants) {
    if (!(term.friction > 0.0)) return;
    const JointForce start = joint_force(term, constants, nodes(x)[slot]);
    const double end = joint_force(term, constants, nodes(to)[slot]).friction;
    const double v = go_on ? duals_[c] : start.friction;
    const double slip = nodes(x)[slot] - term.origin;
    const double change = nodes(p)[slot];
    const double linear =
        (start.sticking * (slip + change) + start.turning * v * change) / term.friction;
    duals[c] = std::clamp(v + std::min(alpha, 1.0) * (linear - v), -1.0, 1.0);
    any = any || std::abs(duals[c] - end) > kClose;
  });
  duals_at_.clear();
  if (!any) return;
  duals_ = std::move(duals);
  duals_at_.assign(nodes(to),
                   nodes(to) + 3 * static_cast<std::ptrdiff_t>(mechanisms_.node_count()));
}

double CoordinatePotential::force_change(const double* x, const double* p) const {
  double largest = 0.0;
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    if (!(term.friction > 0.0)) return;
    const double sticking = joint_force(term, constants, nodes(x)[slot]).sticking;
    largest = std::max(largest, sticking / term.friction * std::abs(nodes(p)[slot]));
  });
  return largest;
}

bool CoordinatePotential::has_duals(const double* x) const {
  return !duals_at_.empty() && std::equal(duals_at_.begin(), duals_at_.end(), nodes(x));
}

double CoordinatePotential::within_speed(Index coordinate, double q) const {
  visit_joints([&](Index c, Index, const JointTerm& term, const JointConstants& constants) {
    if (c != coordinate) return;
    const double reach = (1.0 + 0.5 * constants.zone) * term.velocity_limit * constants.h;
    q = std::clamp(q, term.origin - reach, term.origin + reach);
  });
  return q;
}

double CoordinatePotential::largest_fraction(const double* x,
                                             const double* dx,
                                             double share) const {
  double fraction = std::numeric_limits<double>::infinity();
  visit_joints([&](Index, Index slot, const JointTerm& term, const JointConstants& constants) {
    const double end = (1.0 + constants.zone) * term.velocity_limit * constants.h;
    const double change = nodes(dx)[slot];
    const double slip = nodes(x)[slot] - term.origin;
    const double left = change > 0.0 ? end - slip : end + slip;
    if (std::abs(change) > 0.0) fraction = std::min(fraction, share * left / std::abs(change));
  });
  return fraction;
}

void CoordinatePotential::append_diagonal(std::vector<double>& out) const {
  const std::size_t first = out.size();
  out.resize(first + 3 * static_cast<std::size_t>(mechanisms_.node_count()), 0.0);
  for (const Tree& tree : trees_) {
    for (Index k = 3 * tree.first_node; k < 3 * tree.last_node; ++k) out[first + k] = tree.fill;
    for (std::size_t i = 0; i < tree.slot.size(); ++i) {
      out[first + tree.slot[i]] = at(tree, static_cast<Index>(i), static_cast<Index>(i));
    }
  }
}

}  // namespace diffcloth::bodies
