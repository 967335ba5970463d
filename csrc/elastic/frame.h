#pragma once

#include <algorithm>
#include <cmath>

#include <Eigen/Geometry>

#include "common/types.h"
#include "elastic/degenerate.h"
#include "mesh/rest_shape.h"

namespace diffcloth::elastic {

using Mat32 = Eigen::Matrix<double, 3, 2>;

/// Deformation gradient of a triangle, F = sum_p x_p g_p^T.
inline Mat32 deformation_gradient(const mesh::ShapeGradient& g,
                                  const Vec3& x0,
                                  const Vec3& x1,
                                  const Vec3& x2) {
  // The gradients sum to zero: differences of positions cancel their common offset first.
  return (x1 - x0) * g.row(1) + (x2 - x0) * g.row(2);
}

/// The frame of a triangle, which follows its motion, from the polar decomposition F = R S in closed
/// form.
///
/// With C = F^T F, d = sqrt(det C) and t = sqrt(tr C + 2 d) = tr S:
///
///   S^-1 = [[c22 + d, -c12], [-c12, c11 + d]] / (d t),   R = F S^-1,   n = r1 x r2.
struct Frame {
  Mat3 R;  ///< columns r1, r2, n
  Mat2 S_inv;
  double t;  ///< tr S
  double d;  ///< area ratio, not floored
};

inline Frame frame(const Mat32& F) {
  const Vec3 normal = F.col(0).cross(F.col(1));
  const double c11 = F.col(0).squaredNorm();
  const double c12 = F.col(0).dot(F.col(1));
  const double c22 = F.col(1).squaredNorm();
  Frame result;
  result.d = normal.norm();
  const double d = std::max(result.d, kDegenerate);
  result.t = std::max(std::sqrt(c11 + c22 + 2.0 * result.d), kDegenerate);
  result.S_inv << c22 + d, -c12, -c12, c11 + d;
  result.S_inv /= d * result.t;
  result.R.leftCols<2>() = F * result.S_inv;
  result.R.col(2) = normal / d;
  return result;
}

// First and second derivatives of the frame. For a change dF write K = R^T dF (3x2). The frame
// turns by dR = R [w]x with
//
//   (-w2, w1) = K_3 S^-1,   w3 = (K_21 - K_12) / t.

inline Vec3 rotation(const Frame& frame, const Mat32& K) {
  const Vec2 out_of_plane = frame.S_inv * K.row(2).transpose();
  return {out_of_plane(1), -out_of_plane(0), (K(1, 0) - K(0, 1)) / frame.t};
}

/// The 3x2 matrix V with <V, K> = tau . w(K).
inline Mat32 rotation_adjoint(const Frame& frame, const Vec3& tau) {
  const double in_plane = tau(2) / frame.t;
  Mat32 V;
  V << 0.0, -in_plane, in_plane, 0.0, 0.0, 0.0;
  V.row(2) = (frame.S_inv * Vec2(-tau(1), tau(0))).transpose();
  return V;
}

/// The 3x2 matrix V with <V, K> = tau . (change of w(R^T dF) along a second change of F), where the
/// second change is K_v with rotation w_v, and K = R^T dF.
inline Mat32 rotation_change_adjoint(const Frame& frame,
                                     const Vec3& tau,
                                     const Mat32& K_v,
                                     const Vec3& w_v) {
  // S changes by the in-plane part of K_v minus the rotation of S.
  const double s_scale = frame.S_inv.determinant();
  Mat2 S;  // inverse of S_inv, consistent also if d is floored
  S << frame.S_inv(1, 1), -frame.S_inv(0, 1), -frame.S_inv(1, 0), frame.S_inv(0, 0);
  S /= s_scale;
  Mat2 turned;
  turned << -S(1, 0), -S(1, 1), S(0, 0), S(0, 1);
  const Mat2 dS = K_v.topRows<2>() - w_v(2) * turned;
  const double dt = K_v(0, 0) + K_v(1, 1);

  const Vec2 s_rho = frame.S_inv * Vec2(-tau(1), tau(0));
  const double in_plane = tau(2) / frame.t;
  Mat32 V;
  V.row(0) = w_v(1) * s_rho.transpose();
  V.row(1) = -w_v(0) * s_rho.transpose();
  V.row(2) = -(frame.S_inv * (dS * s_rho)).transpose();
  V.row(2) += in_plane * Eigen::RowVector2d(w_v(0), w_v(1));
  V(0, 0) -= in_plane * w_v(2);
  V(1, 1) -= in_plane * w_v(2);
  V(1, 0) -= in_plane * dt / frame.t;
  V(0, 1) += in_plane * dt / frame.t;
  return V;
}

/// Change of R3 b columns: R [w]x b.
inline Mat3 cross_columns(const Vec3& w, const Mat3& b) {
  Mat3 result;
  for (int k = 0; k < 3; ++k) result.col(k) = w.cross(b.col(k));
  return result;
}

/// sum_k b_k x q_k
inline Vec3 sum_of_crosses(const Mat3& b, const Mat3& q) {
  Vec3 result = Vec3::Zero();
  for (int k = 0; k < 3; ++k) result += b.col(k).cross(q.col(k));
  return result;
}

inline Mat3 cross_matrix(const Vec3& w) {
  Mat3 W;
  W << 0.0, -w(2), w(1), w(2), 0.0, -w(0), -w(1), w(0), 0.0;
  return W;
}

}  // namespace diffcloth::elastic
