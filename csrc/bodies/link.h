#pragma once

// A link, the joint that carries it, and the motion of both; of doubles or of recorded numbers.
//
// The twist of a joint is the velocity of all links that it carries at a unit rate of its coordinate.
// With the axis z through the point o, a joint of kind (turn, slide) that follows its coordinate with
// multiplier m has
//
//   angular = m turn z,   linear = m slide z + o x angular
//
// where `linear` is the velocity of the point at the origin of the reference frame. The point at x moves
// by  linear + angular x x. Joints that carry a joint move its twist like a rigid body, and no other
// joint does. The second derivative of a point by joints i and j, where joint i carries or is joint j,
// is therefore  angular_i x dx/dq_j.

#include <cmath>

#include "bodies/exponential.h"
#include "bodies/joint_kind.h"
#include "bodies/rotations.h"
#include "common/types.h"

namespace diffcloth::bodies {

using Mat34 = Eigen::Matrix<double, 3, 4>;

/// A link and the joint that carries it: T_l = T_parent offset motion(kind, axis, multiplier q + constant).
struct Link {
  Index tree;
  Index parent;  ///< -1 for a root
  JointKind kind;
  Mat34 offset;  ///< of the joint's frame in the parent's frame
  Vec3 axis;     ///< unit vector in the joint's frame
  Index coordinate;
  double multiplier;
  double constant;

  bool moves() const { return kind.moves(); }
  /// Angle [rad] per unit of the coordinate.
  double turn() const { return multiplier * kind.turn; }
  /// Shift [m] per unit of the coordinate.
  double slide() const { return multiplier * kind.slide; }
};

/// Force and moment about the origin, or momentum and angular momentum about it.
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

/// Velocity of a rigid body: its rotation, and the velocity of its point at the origin.
template <class T>
struct Twist {
  Vector3<T> angular = Vector3<T>::Zero();
  Vector3<T> linear = Vector3<T>::Zero();

  Vector3<T> at(const Vector3<T>& x) const { return linear + angular.cross(x); }
  T power(const Wrench<T>& w) const { return angular.dot(w.moment) + linear.dot(w.force); }
  /// Rate of a twist that moves with this one like a rigid body.
  Twist rate_of(const Twist& moved) const {
    return {.angular = angular.cross(moved.angular),
            .linear = angular.cross(moved.linear) + linear.cross(moved.angular)};
  }
};

/// A link in a frame of reference.
template <class T>
struct Placed {
  Matrix3<T> rotation;
  Vector3<T> origin;  ///< of its frame; on the axis of its joint
  Twist<T> joint;     ///< of the joint to the parent; zero if fixed
};

/// Rotation by an angle about a constant axis of unit length.
///
///   R = 1 + sin(a) K + (1 - cos(a)) K^2,   K = axis x
///
/// is smooth in the angle a everywhere, unlike the exponential of a rotation vector at zero.
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

/// Place a link on its parent.
///
/// @param coordinate  of its joint; ignored if the joint is fixed
template <class T>
Placed<T> place_on(const Placed<T>& parent, const Link& link, const T& coordinate) {
  Placed<T> p;
  p.rotation = parent.rotation * link.offset.leftCols<3>().template cast<T>();
  p.origin = parent.origin + parent.rotation * Vector3<T>(link.offset.col(3).template cast<T>());
  if (!link.moves()) return p;
  const T value = link.multiplier * coordinate + link.constant;
  const Vector3<T> axis = p.rotation * link.axis.cast<T>();
  if (link.kind.turn != 0.0) {
    p.joint.angular = T(link.turn()) * axis;
    p.joint.linear = p.origin.cross(p.joint.angular);
    p.rotation = Matrix3<T>(p.rotation * axis_rotation<T>(link.axis, link.kind.turn * value));
  }
  if (link.kind.slide != 0.0) {
    p.joint.linear += T(link.slide()) * axis;
    p.origin += (link.kind.slide * value) * axis;
  }
  return p;
}

}  // namespace diffcloth::bodies
