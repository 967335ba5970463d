#include "bodies/weight_stiffness.h"

#include <algorithm>
#include <cmath>
#include <ranges>

namespace diffcloth::bodies {

// By joints i and j, where joint i carries joint j or i = j, d2V = -(angular_i x P_j) . g, where P_j is
// the momentum of all links that joint j carries at a unit rate of its coordinate. The root's rotation
// vector w carries everything:
//
//   d2V/dw dw = (g . h) 1 - (g h^T + h g^T) / 2,   h = sum_l m_l (c_l - c).
MatrixX<double> weight_stiffness(const Tree& tree,
                                 std::span<const double> mass,
                                 const std::vector<PlacedBody<double>>& placed,
                                 const Vec3& gravity) {
  struct Carried {
    double mass = 0.0;
    Vec3 first = Vec3::Zero();  // sum of mass times position
  };
  std::vector<Carried> carried(placed.size());
  MatrixX<double> K = MatrixX<double>::Zero(tree.size(), tree.size());
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    Carried& own = carried[l];
    own.mass += mass[l];
    own.first += mass[l] * placed[l].center;
    if (link.parent < 0) {
      const Mat3 mixed = gravity * own.first.transpose();
      K.block<3, 3>(3, 3) =
          gravity.dot(own.first) * Mat3::Identity() - 0.5 * (mixed + mixed.transpose());
      continue;
    }
    carried[link.parent].mass += own.mass;
    carried[link.parent].first += own.first;
    if (!link.moves()) continue;
    const Twist<double>& joint = placed[l].joint;
    const Vec3 momentum = own.mass * joint.linear + joint.angular.cross(own.first);
    const Vec3 by_turn = gravity.cross(momentum);  // -(e x P) . g = e . (g x P)
    const Index row = kRoot + link.coordinate;
    K.block<3, 1>(3, row) += by_turn;
    K.block<1, 3>(row, 3) += by_turn.transpose();
    for (Index a = l; a >= 0; a = tree.links[a].parent) {
      const Link& other = tree.links[a];
      if (other.parent < 0 || !other.moves()) continue;
      const double entry = placed[a].joint.angular.dot(by_turn);
      const Index column = kRoot + other.coordinate;
      K(row, column) += entry;
      if (a != l) K(column, row) += entry;
    }
  }
  return K;
}

namespace {

/// A coordinate of the root or a joint, with its effect on the center of one link.
struct Mover {
  Index coordinate;
  double turn;   // angle per unit of the coordinate
  double slide;  // shift per unit of the coordinate
  double way;    // from the axis to the center, along the links between [m]
};

double bound(const Mover& a, const Mover& b) {
  return a.turn * b.turn * std::min(a.way, b.way) + a.turn * b.slide + a.slide * b.turn;
}

}  // namespace

MatrixX<double> weight_stiffness_bound(const Tree& tree,
                                       std::span<const double> mass,
                                       const std::vector<PlacedBody<double>>& placed,
                                       const Vec3& gravity) {
  const auto arm = [&](Index l) { return (placed[l].center - placed[l].origin).norm(); };
  MatrixX<double> K = MatrixX<double>::Zero(tree.size(), tree.size());
  std::vector<Mover> movers;
  for (const Index l : tree.order) {
    movers.clear();
    double way = arm(l);
    for (Index a = l; tree.links[a].parent >= 0; a = tree.links[a].parent) {
      const Link& link = tree.links[a];
      if (link.moves()) {
        movers.push_back({.coordinate = kRoot + link.coordinate,
                          .turn = std::abs(link.turn()),
                          .slide = std::abs(link.slide()),
                          .way = way});
      }
      way += (placed[a].origin - placed[link.parent].origin).norm();
    }
    way += arm(tree.root());
    for (Index i = 3; i < kRoot; ++i) {
      movers.push_back({.coordinate = i, .turn = 1.0, .slide = 0.0, .way = way});
    }
    const double weight = mass[l] * gravity.norm();
    for (const Mover& a : movers) {
      for (const Mover& b : movers) K(a.coordinate, a.coordinate) += weight * bound(a, b);
    }
  }
  return K;
}

}  // namespace diffcloth::bodies
