#pragma once

#include <vector>

#include "common/types.h"

namespace diffcloth::bodies {

/// Pose of a body in the world: position [m] and quaternion wxyz of any nonzero length; 7 doubles.
using Pose = Eigen::Matrix<double, 7, 1>;

/// Rotation matrix of the normalized quaternion of a pose.
Mat3 rotation(const Pose& pose);

/// World positions p + R(q / |q|) y of body-frame points y.
void transform(const Pose& pose, const double* points, Index count, double* out);

/// Pull cotangents of the world positions back to the pose's seven numbers, including normalization.
Pose transform_vjp(const Pose& pose, const double* points, Index count, const double* out_bar);

/// Change of the world positions with a change of the pose's seven numbers.
void transform_jvp(
    const Pose& pose, const Pose& change, const double* points, Index count, double* out);

/// Pose at fraction s between two poses: straight line and great arc (slerp).
Pose interpolate(const Pose& from, const Pose& to, double s);

/// Angle between two poses' rotations, in [0, pi] [rad].
double angle(const Pose& from, const Pose& to);

/// Vertices of the surfaces of all bodies and links, surface by surface.
struct BodySet {
  std::vector<double> vertices;     ///< [3 V] in the frame of the body or link
  std::vector<Index> vertex_start;  ///< [surfaces + 1]
  std::vector<Index> pose;          ///< [surfaces] index of the pose that moves it; -1: none

  Index count() const { return static_cast<Index>(vertex_start.size()) - 1; }
  Index vertex_count() const { return vertex_start.back(); }

  /// World positions of the surfaces that move with a pose.
  void place(const double* poses, double* out) const;

  /// poses_bar += pulled back out_bar [3 V].
  void place_vjp(const double* poses, const double* out_bar, double* poses_bar) const;

  /// Change of the world positions with a change of the poses.
  void place_jvp(const double* poses, const double* change, double* out) const;
};

}  // namespace diffcloth::bodies
