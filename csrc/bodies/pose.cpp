#include "bodies/pose.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Geometry>

namespace diffcloth::bodies {
namespace {

Vec4 unit_quaternion(const Pose& pose) { return pose.tail<4>().normalized(); }

Mat3 matrix(const Vec4& q) { return Eigen::Quaterniond(q[0], q[1], q[2], q[3]).toRotationMatrix(); }

}  // namespace

Mat3 rotation(const Pose& pose) { return matrix(unit_quaternion(pose)); }

void transform(const Pose& pose, const double* points, Index count, double* out) {
  const Mat3 r = rotation(pose);
  for (Index i = 0; i < count; ++i) {
    Eigen::Map<Vec3>(out + 3 * i) = pose.head<3>() + r * row(points, i);
  }
}

// With q = (w, u) of unit length, R(q) y = y + 2 w (u x y) + 2 u x (u x y). For a cotangent z of
// R y:  dL/dw = 2 z . (u x y),  dL/du = 2 w (y x z) + 2 (z (u . y) + y (u . z) - 2 u (y . z)); then
// the normalization q = r / |r| projects:  dL/dr = (I - q q^T) dL/dq / |r|.
Pose transform_vjp(const Pose& pose, const double* points, Index count, const double* out_bar) {
  const Vec4 q = unit_quaternion(pose);
  const Vec3 u = q.tail<3>();
  Vec3 p_bar = Vec3::Zero();
  Vec4 q_bar = Vec4::Zero();
  for (Index i = 0; i < count; ++i) {
    const Vec3 y = row(points, i);
    const Vec3 z = row(out_bar, i);
    p_bar += z;
    q_bar[0] += 2.0 * z.dot(u.cross(y));
    q_bar.tail<3>() +=
        2.0 * q[0] * y.cross(z) + 2.0 * (z * u.dot(y) + y * u.dot(z) - 2.0 * u * y.dot(z));
  }
  Pose result;
  result.head<3>() = p_bar;
  result.tail<4>() = (q_bar - q * q.dot(q_bar)) / pose.tail<4>().norm();
  return result;
}

void transform_jvp(
    const Pose& pose, const Pose& change, const double* points, Index count, double* out) {
  const Vec4 q = unit_quaternion(pose);
  const Vec4 r_dot = change.tail<4>();
  const Vec4 q_dot = (r_dot - q * q.dot(r_dot)) / pose.tail<4>().norm();
  const Vec3 u = q.tail<3>();
  const Vec3 u_dot = q_dot.tail<3>();
  for (Index i = 0; i < count; ++i) {
    const Vec3 y = row(points, i);
    const Vec3 side = u.cross(y);
    const Vec3 side_dot = u_dot.cross(y);
    Eigen::Map<Vec3>(out + 3 * i) =
        change.head<3>() +
        2.0 * (q_dot[0] * side + q[0] * side_dot + u_dot.cross(side) + u.cross(side_dot));
  }
}

Pose interpolate(const Pose& from, const Pose& to, double s) {
  const Vec4 a = unit_quaternion(from);
  const Vec4 b = unit_quaternion(to);
  const Eigen::Quaterniond q = Eigen::Quaterniond(a[0], a[1], a[2], a[3])
                                   .slerp(s, Eigen::Quaterniond(b[0], b[1], b[2], b[3]));
  Pose result;
  result << (1.0 - s) * from.head<3>() + s * to.head<3>(), q.w(), q.x(), q.y(), q.z();
  return result;
}

double angle(const Pose& from, const Pose& to) {
  const Vec4 a = unit_quaternion(from);
  const Vec4 b = unit_quaternion(to);
  // Half the chord between the nearer of b and -b: accurate for small angles, unlike acos(a . b).
  const double half_chord = 0.5 * std::min((a - b).norm(), (a + b).norm());
  return 4.0 * std::asin(std::min(half_chord, 1.0));
}

void BodySet::place(const double* poses, double* out) const {
  for (Index k = 0; k < count(); ++k) {
    if (pose[k] < 0) continue;
    const Index first = vertex_start[k];
    transform(Eigen::Map<const Pose>(poses + 7 * pose[k]), vertices.data() + 3 * first,
              vertex_start[k + 1] - first, out + 3 * first);
  }
}

void BodySet::place_vjp(const double* poses, const double* out_bar, double* poses_bar) const {
  for (Index k = 0; k < count(); ++k) {
    if (pose[k] < 0) continue;
    const Index first = vertex_start[k];
    Eigen::Map<Pose>(poses_bar + 7 * pose[k]) +=
        transform_vjp(Eigen::Map<const Pose>(poses + 7 * pose[k]), vertices.data() + 3 * first,
                      vertex_start[k + 1] - first, out_bar + 3 * first);
  }
}

void BodySet::place_jvp(const double* poses, const double* change, double* out) const {
  for (Index k = 0; k < count(); ++k) {
    if (pose[k] < 0) continue;
    const Index first = vertex_start[k];
    transform_jvp(Eigen::Map<const Pose>(poses + 7 * pose[k]),
                  Eigen::Map<const Pose>(change + 7 * pose[k]), vertices.data() + 3 * first,
                  vertex_start[k + 1] - first, out + 3 * first);
  }
}

}  // namespace diffcloth::bodies
