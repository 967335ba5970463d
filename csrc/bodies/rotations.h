#pragma once

// Rotations as quaternions (w, x, y, z), of doubles or of recorded numbers; smooth at zero. The formulas
// are the same as in diffcloth_torch/geometry/rotation.py.

#include <cmath>

#include <Eigen/Core>
#include <Eigen/Geometry>  // cross()

namespace diffcloth::bodies {

template <class T>
using Vector3 = Eigen::Matrix<T, 3, 1>;
template <class T>
using Matrix3 = Eigen::Matrix<T, 3, 3>;
/// (w, x, y, z)
template <class T>
using Quaternion4 = Eigen::Matrix<T, 4, 1>;

/// Angle [rad] below which the exponential is summed as a series; its first neglected terms are 0.1^10 /
/// (2^10 10!) = 3e-20 for the cosine and less for the sine.
inline constexpr double kSeriesAngle = 0.1;

/// Bound of sin(a / 2) below which a logarithm uses a / sin(a / 2) = 2, accurate to rounding.
inline constexpr double kSmallestSine = 1e-9;

/// Exponential of a rotation vector w [rad]: (cos(a/2), sin(a/2)/a w) with a = |w|.
template <class T>
Quaternion4<T> quaternion_exp(const Vector3<T>& w) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  const T angle_sq = w.dot(w);
  T cosine;
  T half_sine;  // sin(a/2) / a
  if (angle_sq < T(kSeriesAngle * kSeriesAngle)) {
    const T s = angle_sq / 4.0;
    cosine = 1.0 - s * (0.5 - s * (1.0 / 24.0 - s * (1.0 / 720.0 - s / 40320.0)));
    half_sine =
        0.5 * (1.0 - s * (1.0 / 6.0 - s * (1.0 / 120.0 - s * (1.0 / 5040.0 - s / 362880.0))));
  } else {
    const T angle = sqrt(angle_sq);
    cosine = cos(angle / 2.0);
    half_sine = sin(angle / 2.0) / angle;
  }
  return {cosine, half_sine * w[0], half_sine * w[1], half_sine * w[2]};
}

/// Rotation vector [rad] of a unit quaternion, at most pi long.
template <class T>
Vector3<T> quaternion_log(const Quaternion4<T>& q) {
  using std::atan2;
  using std::sqrt;
  // q and -q are the same rotation; the one with w >= 0 turns by pi or less.
  const double sign = q[0] < T(0.0) ? -1.0 : 1.0;
  const T w = sign * q[0];
  const Vector3<T> v(sign * q[1], sign * q[2], sign * q[3]);
  const T sine_sq = v.dot(v);
  if (sine_sq < T(kSmallestSine * kSmallestSine)) return v * T(2.0);
  const T sine = sqrt(sine_sq);
  return v * T(2.0 * atan2(sine, w) / sine);
}

/// The rotation b followed by a.
template <class T>
Quaternion4<T> quaternion_multiply(const Quaternion4<T>& a, const Quaternion4<T>& b) {
  const Vector3<T> av = a.template tail<3>();
  const Vector3<T> bv = b.template tail<3>();
  const Vector3<T> v = a[0] * bv + b[0] * av + av.cross(bv);
  return {a[0] * b[0] - av.dot(bv), v[0], v[1], v[2]};
}

template <class T>
Quaternion4<T> conjugate(const Quaternion4<T>& q) {
  return {q[0], -q[1], -q[2], -q[3]};
}

template <class T>
Quaternion4<T> normalized(const Quaternion4<T>& q) {
  using std::sqrt;
  const T length = sqrt(q.dot(q));
  return {q[0] / length, q[1] / length, q[2] / length, q[3] / length};
}

/// q or -q, which represent the same rotation: the one nearer to `other`.
template <class T>
Quaternion4<T> nearer_quaternion(const Quaternion4<T>& q, const Quaternion4<T>& other) {
  if (q.dot(other) < T(0.0)) return -q;
  return q;
}

/// Rotation matrix of a unit quaternion.
template <class T>
Matrix3<T> quaternion_matrix(const Quaternion4<T>& q) {
  const T ww = q[0] * q[0], xx = q[1] * q[1], yy = q[2] * q[2], zz = q[3] * q[3];
  const T wx = q[0] * q[1], wy = q[0] * q[2], wz = q[0] * q[3];
  const T xy = q[1] * q[2], xz = q[1] * q[3], yz = q[2] * q[3];
  Matrix3<T> R;
  R << 2.0 * (ww + xx) - 1.0, 2.0 * (xy - wz), 2.0 * (xz + wy),  //
      2.0 * (xy + wz), 2.0 * (ww + yy) - 1.0, 2.0 * (yz - wx),   //
      2.0 * (xz - wy), 2.0 * (yz + wx), 2.0 * (ww + zz) - 1.0;
  return R;
}

/// Torque J(w)^-T Q that does the work of a generalized force Q on a rotation vector w shorter than 2
/// pi: Q + w x Q / 2 + b w x (w x Q) with b = (1 - (a/2) cot(a/2)) / a^2 and a = |w|.
template <class T>
Vector3<T> torque_from_moment(const Vector3<T>& w, const Vector3<T>& moment) {
  using std::cos;
  using std::sin;
  using std::sqrt;
  const T angle_sq = w.dot(w);
  T b;
  if (angle_sq < T(kSeriesAngle * kSeriesAngle)) {
    // The first neglected term is 3e-9 0.1^10.
    const T& s = angle_sq;
    b = 1.0 / 12.0 +
        s * (1.0 / 720.0 + s * (1.0 / 30240.0 + s * (1.0 / 1209600.0 + s / 47900160.0)));
  } else {
    const T half = sqrt(angle_sq) / 2.0;
    b = (1.0 - half * cos(half) / sin(half)) / angle_sq;
  }
  const Vector3<T> turned = w.cross(moment);
  return moment + turned / T(2.0) + b * w.cross(turned);
}

/// Rotation vector [rad] from one unit quaternion to another.
template <class T>
Vector3<T> turn_between(const Quaternion4<T>& from, const Quaternion4<T>& to) {
  return quaternion_log<T>(quaternion_multiply<T>(to, conjugate<T>(from)));
}

}  // namespace diffcloth::bodies
