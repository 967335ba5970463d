#pragma once

// Momenta and forces of a tree of links in the velocities nu = (dc/dt, omega, dq/dt) of its root and
// its joints: recursions along the tree, of doubles or of recorded numbers.
//
// With the 6 velocities V_l = J_l nu of each link, those of its center and of rotation, and its mass
// and inertia W_l in world axes,
//
//   M = sum_l J_l^T W_l J_l,   p = M nu.
//
// Let joint j turn about the axis z through the point o, and let F and N be the momentum and the
// angular momentum about o of all links that it carries. Then p_j = z . N (z . F if it slides). A turn
// of the joint moves all links that it carries and no others, so the kinetic energy T = p . nu / 2
// grows with its value, at constant rates, by
//
//   dT/dq_j = dz/dt . N + z . (F x do/dt),   dz/dt = omega x z      (dz/dt . F where it slides).
//
// Lagrange's equations are dp/dt = dT/dq + forces. Those of the root's rotation, in world axes, have
// the same form if its slope is P x dc/dt, with the momentum P of all.
//
// Points are relative to the root's center of mass c: what moves far from the origin of the world has
// the same rounding.

#include <cmath>
#include <ranges>
#include <span>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>  // cross()

#include "bodies/mechanisms.h"
#include "bodies/rotations.h"

namespace diffcloth::bodies {

inline constexpr Index kRoot = 6;  ///< velocities of the root, which come first

template <class T>
using VectorX = Eigen::Matrix<T, Eigen::Dynamic, 1>;
template <class T>
using MatrixX = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;

/// Links of one mechanism, in any order; a coordinate is the place of a joint among the J.
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

/// A link in the world.
template <class T>
struct Placed {
  Matrix3<T> rotation;
  Vector3<T> origin;  ///< of its frame; the axis of its joint goes through it
  Vector3<T> axis;    ///< of its joint to the parent
  Vector3<T> arm;     ///< from the origin to the center of mass
};

/// Force and moment about c, or momentum and angular momentum about it.
template <class T>
struct Wrench {
  Vector3<T> force = Vector3<T>::Zero();
  Vector3<T> moment = Vector3<T>::Zero();

  Wrench& operator+=(const Wrench& other) {
    force += other.force;
    moment += other.moment;
    return *this;
  }
};

/// Turn by an angle about a constant axis of unit length.
template <class T>
Matrix3<T> axis_rotation(const Vec3& axis, const T& angle) {
  using std::cos;
  using std::sin;
  const Mat3 K = cross_matrix(axis);
  const Mat3 K_sq = K * K;
  const T s = sin(angle);
  const T c = 1.0 - cos(angle);
  Matrix3<T> R;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) R(i, j) = (i == j ? 1.0 : 0.0) + s * K(i, j) + c * K_sq(i, j);
  }
  return R;
}

/// Place all links, from the orientation of the root and the values of the joints.
template <class T>
std::vector<Placed<T>> place(const Tree& tree,
                             const TreeInertia<T>& inertia,
                             const Matrix3<T>& root_rotation,
                             const VectorX<T>& joints) {
  std::vector<Placed<T>> placed(tree.links.size());
  for (const Index l : tree.order) {
    const Link& link = tree.links[l];
    Placed<T>& p = placed[l];
    p.axis.setZero();
    if (link.parent < 0) {
      p.rotation = root_rotation;
      p.arm = p.rotation * inertia.center_of(l);
      p.origin = -p.arm;
      continue;
    }
    const Placed<T>& parent = placed[link.parent];
    p.rotation = parent.rotation * link.offset.leftCols<3>().template cast<T>();
    p.origin = parent.origin + parent.rotation * Vector3<T>(link.offset.col(3).template cast<T>());
    if (link.kind != JointKind::kFixed) {
      const T value = link.multiplier * joints[link.coordinate] + link.constant;
      p.axis = p.rotation * link.axis.cast<T>();
      if (link.kind == JointKind::kRevolute) {
        p.rotation = Matrix3<T>(p.rotation * axis_rotation<T>(link.axis, value));
      } else {
        p.origin += value * p.axis;
      }
    }
    p.arm = p.rotation * inertia.center_of(l);
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
                   const std::vector<Placed<T>>& placed,
                   const VectorX<T>& nu) {
  struct Moving {
    Vector3<T> omega;
    Vector3<T> velocity;  // of the origin
    Wrench<T> momentum;   // of all that hangs on the link
  };
  std::vector<Moving> moving(placed.size());
  for (const Index l : tree.order) {
    const Link& link = tree.links[l];
    const Placed<T>& p = placed[l];
    Moving& m = moving[l];
    if (link.parent < 0) {
      m.omega = nu.template segment<3>(3);
      m.velocity = nu.template head<3>() + m.omega.cross(p.origin);
    } else {
      const Moving& parent = moving[link.parent];
      m.omega = parent.omega;
      m.velocity = parent.velocity + parent.omega.cross(p.origin - placed[link.parent].origin);
      if (link.kind != JointKind::kFixed) {
        const T rate = link.multiplier * nu[kRoot + link.coordinate];
        (link.kind == JointKind::kRevolute ? m.omega : m.velocity) += rate * p.axis;
      }
    }
    m.momentum.force = inertia.mass[l] * (m.velocity + m.omega.cross(p.arm));
    const Vector3<T> local = p.rotation.transpose() * m.omega;
    const Vector3<T> spin = p.rotation * Vector3<T>(inertia.inertia_of(l) * local);
    m.momentum.moment = spin + (p.origin + p.arm).cross(m.momentum.force);
  }

  TreeRates<T> out{.momentum = VectorX<T>::Zero(tree.size()),
                   .slope = VectorX<T>::Zero(tree.size())};
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const Placed<T>& p = placed[l];
    const Moving& m = moving[l];
    const Vector3<T>& force = m.momentum.force;
    if (link.parent < 0) {
      out.momentum.template head<3>() = force;
      out.momentum.template segment<3>(3) = m.momentum.moment;
      out.slope.template segment<3>(3) = force.cross(Vector3<T>(nu.template head<3>()));
      continue;
    }
    moving[link.parent].momentum += m.momentum;
    if (link.kind == JointKind::kFixed) continue;
    const Vector3<T> axis_rate = m.omega.cross(p.axis);
    T along = p.axis.dot(force);
    T change = axis_rate.dot(force);
    if (link.kind == JointKind::kRevolute) {
      const Vector3<T> moment = m.momentum.moment - p.origin.cross(force);  // about the axis
      along = p.axis.dot(moment);
      change = axis_rate.dot(moment) + p.axis.dot(force.cross(m.velocity));
    }
    out.momentum[kRoot + link.coordinate] += link.multiplier * along;
    out.slope[kRoot + link.coordinate] += link.multiplier * change;
  }
  for (Index j = 0; j < tree.joint_count; ++j) {
    out.momentum[kRoot + j] += inertia.armature[j] * nu[kRoot + j];
  }
  return out;
}

/// sum_l J_l^T f_l of wrenches on the links; `wrenches` then have those of all that a link carries.
template <class T>
VectorX<T> generalized_force(const Tree& tree,
                             const std::vector<Placed<T>>& placed,
                             std::vector<Wrench<T>>& wrenches) {
  VectorX<T> out = VectorX<T>::Zero(tree.size());
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const Placed<T>& p = placed[l];
    const Wrench<T>& w = wrenches[l];
    if (link.parent < 0) {
      out.template head<3>() = w.force;
      out.template segment<3>(3) = w.moment;
      continue;
    }
    wrenches[link.parent] += w;
    if (link.kind == JointKind::kFixed) continue;
    const T along = link.kind == JointKind::kRevolute
                        ? p.axis.dot(Vector3<T>(w.moment - p.origin.cross(w.force)))
                        : p.axis.dot(w.force);
    out[kRoot + link.coordinate] += link.multiplier * along;
  }
  return out;
}

/// M with the armature on its diagonal, from the inertia of all that each joint carries.
template <class T>
MatrixX<T> mass_matrix(const Tree& tree,
                       const TreeInertia<T>& inertia,
                       const std::vector<Placed<T>>& placed) {
  struct Carried {
    T mass = 0.0;
    Vector3<T> first = Vector3<T>::Zero();   // sum of mass times place
    Matrix3<T> second = Matrix3<T>::Zero();  // inertia about c
  };
  std::vector<Carried> carried(placed.size());
  MatrixX<T> M = MatrixX<T>::Zero(tree.size(), tree.size());
  for (const Index l : std::views::reverse(tree.order)) {
    const Link& link = tree.links[l];
    const Placed<T>& p = placed[l];
    Carried& own = carried[l];
    const T& m = inertia.mass[l];
    const Vector3<T> at = p.origin + p.arm;
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
        // The momentum omega x h of a turn.
        M(j, 3 + i) = M(3 + i, j) = -h[k];
        M(k, 3 + i) = M(3 + i, k) = h[j];
      }
      continue;
    }
    Carried& above = carried[link.parent];
    above.mass += own.mass;
    above.first += own.first;
    above.second += own.second;
    if (link.kind == JointKind::kFixed) continue;
    // Momentum of all that the joint carries when it alone moves, at unit speed.
    Wrench<T> momentum;
    const auto moves = [&](const Placed<T>& by, JointKind kind) {
      const bool turns = kind == JointKind::kRevolute;
      return turns ? Vector3<T>(by.origin.cross(by.axis)) : by.axis;  // of a point that is at c
    };
    const Vector3<T> velocity = moves(p, link.kind);
    if (link.kind == JointKind::kRevolute) {
      momentum.force = own.mass * velocity + p.axis.cross(own.first);
      momentum.moment = own.second * p.axis + own.first.cross(velocity);
    } else {
      momentum.force = own.mass * velocity;
      momentum.moment = own.first.cross(velocity);
    }
    const Index row = kRoot + link.coordinate;
    for (int i = 0; i < 3; ++i) {
      const T linear = link.multiplier * momentum.force[i];
      const T angular = link.multiplier * momentum.moment[i];
      M(i, row) += linear;
      M(row, i) += linear;
      M(3 + i, row) += angular;
      M(row, 3 + i) += angular;
    }
    for (Index a = l; a >= 0; a = tree.links[a].parent) {
      const Link& other = tree.links[a];
      if (other.parent < 0 || other.kind == JointKind::kFixed) continue;
      const Placed<T>& q = placed[a];
      T along = moves(q, other.kind).dot(momentum.force);
      if (other.kind == JointKind::kRevolute) along += q.axis.dot(momentum.moment);
      const T entry = link.multiplier * other.multiplier * along;
      const Index column = kRoot + other.coordinate;
      M(row, column) += entry;
      if (a != l) M(column, row) += entry;
    }
  }
  for (Index j = 0; j < tree.joint_count; ++j) M(kRoot + j, kRoot + j) += inertia.armature[j];
  return M;
}

}  // namespace diffcloth::bodies
