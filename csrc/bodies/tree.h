#pragma once

// Momenta and forces of a tree of links in terms of the velocities nu = (dc/dt, omega, dq/dt) of its
// root and its joints: recursions along the tree, of doubles or of recorded numbers.
//
// With the 6 velocities V_l = J_l nu of each link (of its center and of rotation), and its mass and
// inertia W_l in world axes,
//
//   M = sum_l J_l^T W_l J_l,   p = M nu.
//
// All twists, momenta and forces are about the root's center of mass c, so that rounding does not grow
// with the distance from the world's origin. Let h be the momentum of all links that joint j carries,
// S_j the twist of the joint and V_j the velocity of its link. Then p_j = S_j . h. A change of the
// coordinate moves all links that the joint carries and no others, so the kinetic energy T = p . nu / 2
// grows with it, at constant rates, by
//
//   dT/dq_j = (rate of S_j as it moves with V_j) . h.
//
// Lagrange's equations are dp/dt = dT/dq + forces. The equations of the root's rotation, in world axes,
// have the same form if their slope is P x dc/dt, with the momentum P of all links.

#include <ranges>
#include <span>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>  // cross()

#include "bodies/link.h"
#include "bodies/rotations.h"

namespace diffcloth::bodies {

inline constexpr Index kRoot = 6;  ///< number of velocities of the root, which come first

template <class T>
using VectorX = Eigen::Matrix<T, Eigen::Dynamic, 1>;
template <class T>
using MatrixX = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;

/// Links of one mechanism, in any order; a coordinate is the index of a joint among the J.
struct Tree {
  std::vector<Link> links;
  std::vector<Index> order;  ///< parents before their children
  Index joint_count = 0;

  Index root() const { return order.front(); }
  Index size() const { return kRoot + joint_count; }
};

/// Masses and inertias of links and joints.
template <class T>
struct TreeInertia {
  const T* mass;      ///< [L] kg
  const T* center;    ///< [L, 3] in the links' frames, m
  const T* inertia;   ///< [L, 3, 3] about the centers, in the links' axes, kg m^2
  const T* armature;  ///< [J] kg m^2 or kg

  Vector3<T> center_of(Index l) const {
    return {center[3 * l], center[3 * l + 1], center[3 * l + 2]};
  }
  Matrix3<T> inertia_of(Index l) const {
    return Eigen::Map<const Eigen::Matrix<T, 3, 3, Eigen::RowMajor>>(inertia + 9 * l);
  }
};

/// A link with a center of mass.
template <class T>
struct PlacedBody : Placed<T> {
  Vector3<T> center;
};

/// Place all links, from the orientation of the root and the values of the joints.
template <class T>
std::vector<PlacedBody<T>> place(const Tree& tree,
                                 const TreeInertia<T>& inertia,
                                 const Matrix3<T>& root_rotation,
                                 const VectorX<T>& joints) {
  std::vector<PlacedBody<T>> placed(tree.links.size());
  for (const Index l : tree.order) {
    const Link& link = tree.links[l];
    PlacedBody<T>& p = placed[l];
    if (link.parent < 0) {
      p.rotation = root_rotation;
      p.origin = -(p.rotation * inertia.center_of(l));
      p.center.setZero();
      continue;
    }
    const T coordinate = link.moves() ? joints[link.coordinate] : T(0.0);
    static_cast<Placed<T>&>(p) = place_on<T>(placed[link.parent], link, coordinate);
    p.center = p.origin + p.rotation * inertia.center_of(l);
  }
  return placed;
}

/// Momentum p and slope s = dT/dq of velocities nu.
template <class T>
struct TreeRates {
  VectorX<T> momentum;
  VectorX<T> slope;
};

template <class T>
TreeRates<T> rates(const Tree& tree,
                   const TreeInertia<T>& inertia,
                   const std::vector<PlacedBody<T>>& placed,
                   const VectorX<T>& nu) {
  std::vector<Twist<T>> velocity(placed.size());
  std::vector<Wrench<T>> momentum(placed.size());  // of all links carried, including itself
  for (const Index l : tree.order) {
    const Link& link = tree.links[l];
    const PlacedBody<T>& p = placed[l];
    Twist<T>& v = velocity[l];
    if (link.parent < 0) {
      v = {.angular = nu.template segment<3>(3), .linear = nu.template head<3>()};
    } else {
      v = velocity[link.parent];
      if (link.moves()) {
        const T& rate = nu[kRoot + link.coordinate];
        v.angular += rate * p.joint.angular;
        v.linear += rate * p.joint.linear;
      }
    }
    momentum[l].force = inertia.mass[l] * v.at(p.center);
    const Vector3<T> local = p.rotation.transpose() * v.angular;
    const Vector3<T> spin = p.rotation * Vector3<T>(inertia.inertia_of(l) * local);
    momentum[l].moment = spin + p.center.cross(momentum[l].force);
  }

  TreeRates<T> out{.momentum = VectorX<T>::Zero(tree.size()),
                   .slope = VectorX<T>::Zero(tree.size())};
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const Wrench<T>& h = momentum[l];
    if (link.parent < 0) {
      out.momentum.template head<3>() = h.force;
      out.momentum.template segment<3>(3) = h.moment;
      out.slope.template segment<3>(3) = h.force.cross(Vector3<T>(nu.template head<3>()));
      continue;
    }
    momentum[link.parent] += h;
    if (!link.moves()) continue;
    const Twist<T>& joint = placed[l].joint;
    out.momentum[kRoot + link.coordinate] += joint.power(h);
    out.slope[kRoot + link.coordinate] += velocity[l].rate_of(joint).power(h);
  }
  for (Index j = 0; j < tree.joint_count; ++j) {
    out.momentum[kRoot + j] += inertia.armature[j] * nu[kRoot + j];
  }
  return out;
}

/// sum_l J_l^T f_l of wrenches on the links. Afterwards `wrenches` holds the sums over all links that
/// each link carries.
template <class T>
VectorX<T> generalized_force(const Tree& tree,
                             const std::vector<PlacedBody<T>>& placed,
                             std::vector<Wrench<T>>& wrenches) {
  VectorX<T> out = VectorX<T>::Zero(tree.size());
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const Wrench<T>& w = wrenches[l];
    if (link.parent < 0) {
      out.template head<3>() = w.force;
      out.template segment<3>(3) = w.moment;
      continue;
    }
    wrenches[link.parent] += w;
    if (link.moves()) out[kRoot + link.coordinate] += placed[l].joint.power(w);
  }
  return out;
}

/// M with the armature on its diagonal, from the inertia of all links that each joint carries.
template <class T>
MatrixX<T> mass_matrix(const Tree& tree,
                       const TreeInertia<T>& inertia,
                       const std::vector<PlacedBody<T>>& placed) {
  struct Carried {
    T mass = 0.0;
    Vector3<T> first = Vector3<T>::Zero();   // sum of mass times position
    Matrix3<T> second = Matrix3<T>::Zero();  // inertia about c
  };
  std::vector<Carried> carried(placed.size());
  MatrixX<T> M = MatrixX<T>::Zero(tree.size(), tree.size());
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const PlacedBody<T>& p = placed[l];
    Carried& own = carried[l];
    const T& m = inertia.mass[l];
    const Vector3<T>& at = p.center;
    own.mass += m;
    own.first += m * at;
    own.second += p.rotation * Matrix3<T>(inertia.inertia_of(l) * p.rotation.transpose());
    own.second -= m * Matrix3<T>(at * at.transpose());
    const T size_sq = m * at.dot(at);
    for (int i = 0; i < 3; ++i) own.second(i, i) += size_sq;
    if (link.parent < 0) {
      const Vector3<T>& h = own.first;
      M.template block<3, 3>(3, 3) = own.second;
      for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const int k = (i + 2) % 3;
        M(i, i) = own.mass;
        // Momentum omega x h of a rotation.
        M(j, 3 + i) = M(3 + i, j) = -h[k];
        M(k, 3 + i) = M(3 + i, k) = h[j];
      }
      continue;
    }
    Carried& above = carried[link.parent];
    above.mass += own.mass;
    above.first += own.first;
    above.second += own.second;
    if (!link.moves()) continue;
    // Momentum of all links that the joint carries, when only this joint moves, at unit rate.
    const Twist<T>& joint = p.joint;
    Wrench<T> momentum;
    momentum.force = own.mass * joint.linear + joint.angular.cross(own.first);
    momentum.moment = own.second * joint.angular + own.first.cross(joint.linear);
    const Index row = kRoot + link.coordinate;
    for (int i = 0; i < 3; ++i) {
      M(i, row) += momentum.force[i];
      M(row, i) += momentum.force[i];
      M(3 + i, row) += momentum.moment[i];
      M(row, 3 + i) += momentum.moment[i];
    }
    for (Index a = l; a >= 0; a = tree.links[a].parent) {
      const Link& other = tree.links[a];
      if (other.parent < 0 || !other.moves()) continue;
      const T entry = placed[a].joint.power(momentum);
      const Index column = kRoot + other.coordinate;
      M(row, column) += entry;
      if (a != l) M(column, row) += entry;
    }
  }
  for (Index j = 0; j < tree.joint_count; ++j) M(kRoot + j, kRoot + j) += inertia.armature[j];
  return M;
}

}  // namespace diffcloth::bodies
