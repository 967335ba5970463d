#pragma once

#include <Eigen/Core>

#include "common/types.h"
#include "contact/distance/separation.h"
#include "contact/pair.h"

namespace diffcloth::contact {

/// Closest vector t = sum_i c_i(beta) x_i of a pair.
///
/// With parameters beta where the closest points are free to slide (c' = dc/dbeta):
///
///   type         c (of the corners that take part)  beta    c'_a                          s_a
///   point-point  (1, -1)                            -       -                             -
///   point-edge   (1, -(1 - a), -a)                  a       (0, 1, -1)                    -e
///   point-plane  (1, -(1 - b0 - b1), -b0, -b1)      b0, b1  (0, 1, -1, 0), (0, 1, 0, -1)  -e0, -e1
///   line-line    (1 - s, s, -(1 - t), -t)           s, t    (-1, 1, 0, 0), (0, 0, 1, -1)  u, -v
///
///   D = |t|^2,   s_a = dt/dbeta_a,   M_ab = s_a . s_b,   G_(i),a = c_i s_a + c'_(a,i) t
///   grad D = 2 c (x) t,   hess D = 2 c c^T (x) I - 2 G M^-1 G^T,   dbeta = -M^-1 G^T dx
///
/// Corners that do not take part have c_i = 0 and zero rows in c_beta; parameters that do not exist
/// have zero columns in c_beta, s and M_inv.
struct Closest {
  Vec4 c;
  int parameter_count;
  Eigen::Matrix<double, 4, 2> c_beta;
  Eigen::Matrix<double, 3, 2> s;
  Mat2 M_inv;
  Vec3 t;       ///< From the second primitive to the first [m].
  double d_sq;  ///< |t|^2 [m^2].
};

/// Classify a pair by the region that its closest points lie in, and describe its closest vector.
///
/// A degenerate triangle is replaced by the nearest of its edges. Edges with |u x v|^2 below 2.5e-16
/// |u|^2 |v|^2 are parallel and never of type line-line.
Closest closest(PairKind kind, const Corners& x);

/// Location of the closest points, with the same bits as by closest(), but without derivatives, which
/// double the cost.
struct ClosestPoints {
  Vec4 c;
  int parameter_count;
  double d_sq;  ///< [m^2]
};
ClosestPoints closest_points(PairKind kind, const Corners& x);

/// Gradient of the squared distance, corner by corner [m].
Vec12 distance_sq_gradient(const Closest& pair);

/// Hessian of the squared distance [-]; exact, hence indefinite.
Mat12 distance_sq_hessian(const Closest& pair);

/// Part of the Hessian due to sliding of the closest points, left right^T = -2 G M^-1 G^T; the other
/// part is 2 c c^T (x) I. Columns beyond parameter_count are zero.
struct Sliding {
  Eigen::Matrix<double, 12, 2> left;
  Eigen::Matrix<double, 12, 2> right;
};
Sliding sliding(const Closest& pair);

/// Change of the parameters with the corners, dbeta/dx [1/m]; rows beyond parameter_count are zero.
Eigen::Matrix<double, 2, 12> beta_jacobian(const Closest& pair);

}  // namespace diffcloth::contact
