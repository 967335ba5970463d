#pragma once

#include <array>

#include "common/types.h"

namespace diffcloth::contact {

enum class PairKind : std::uint8_t { kPointTriangle, kEdgeEdge };

/// Corners of a pair: point, t0, t1, t2; or a0, a1, b0, b1.
using Corners = std::array<Vec3, 4>;

/// Closest vector of a pair of primitives, from the second to the first:
///
///   t = sum_i c_i(beta) x_i,   D = |t|^2,   s_a = dt/d(beta_a),   M_ab = s_a . s_b
///
/// for the closest features: point-point (no beta), point-edge (one), point-triangle and edge-edge
/// (two). Corners that take no part have c_i = 0 and zero rows in c_beta.
struct Closest {
  Vec4 c;
  int parameter_count;
  Eigen::Matrix<double, 4, 2> c_beta;  ///< dc_i/d(beta_a)
  Eigen::Matrix<double, 3, 2> s;
  Mat2 M_inv;
  Vec3 t;
  double d_sq;
};

/// Closest vector between point and triangle, or between two edges.
Closest closest(PairKind kind, const Corners& x);

/// grad D = 2 c (x) t.
Vec12 distance_sq_gradient(const Closest& k);

/// hess D = 2 (c c^T (x) I) - 2 G M^-1 G^T,   G_(i),a = c_i s_a + c'_(a,i) t.
Mat12 distance_sq_hessian(const Closest& k);

/// d(beta)/dx = -M^-1 G^T; unused rows are zero.
Eigen::Matrix<double, 2, 12> beta_jacobian(const Closest& k);

/// Squared distance for collision detection: interior features only where they are well
/// conditioned, else the nearest of the clamped point-edge distances, which exceeds the true one by
/// rounding at most.
double distance_sq(PairKind kind, const Corners& x);

}  // namespace diffcloth::contact
