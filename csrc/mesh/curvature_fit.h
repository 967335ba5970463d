#pragma once

#include <array>
#include <numbers>

#include <Eigen/Core>

#include "common/types.h"

namespace diffcloth::mesh {

/// Most points of a quadratic: a triangle and the vertices across its sides.
inline constexpr int kMaxQuadratic = 6;
/// Most points that are unfolded together. The two triangles of a side and two layers around them have
/// 16 points; further layers are only added to five points or fewer, which have ten edges.
inline constexpr int kMaxPoints = 16;

/// The equation of one extra point in the fit of a patch.
///
/// With barycentric coordinates lambda_i with respect to the base triangle, the residual
/// r = x - sum_i lambda_i x_i of a quadratic map is m . A (x,uu ; sqrt2 x,uv ; x,vv).
template <class Scalar>
struct FitRow {
  std::array<Scalar, 3> lambda;
  std::array<Scalar, 3> m;
};

/// @param p  base triangle (length, a, b), extra point (u, v)
template <class Scalar>
FitRow<Scalar> fit_row(const std::array<Scalar, 5>& p) {
  const auto& [length, a, b, u, v] = p;
  const Scalar lambda2 = v / b;
  const Scalar lambda1 = (u - a * lambda2) / length;
  const Scalar scale = Scalar(1.0) / (length * b);  // 1 / (2 A)
  const Scalar sqrt2(std::numbers::sqrt2);
  return {.lambda = {Scalar(1.0) - lambda1 - lambda2, lambda1, lambda2},
          .m = {scale * (u * u - lambda1 * length * length - lambda2 * a * a),
                scale * (sqrt2 * (u * v - lambda2 * a * b)), scale * (v * v - lambda2 * b * b)}};
}

/// Rows of a fit, one for each point; at least three (rows of zeros change nothing).
using FitMatrix = Eigen::Matrix<double, Eigen::Dynamic, 3, 0, kMaxPoints, 3>;
using FitInverse = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, kMaxPoints>;

Vec3 singular_values(const FitMatrix& M);

/// Smooth pseudo-inverse: V f(S) U^T of M = U S V^T with f(s) = s^7 / (s^8 + floor^8).
///
/// f is odd and analytic, so the inverse is smooth in M also where the rank changes, and a direction
/// that the points do not determine (in a strip one triangle wide) stays undetermined to first order. f
/// differs from 1/s by less than 0.7 % if s is twice the floor, and by less than 2e-4 if s is three
/// times the floor.
FitInverse fit_inverse(const FitMatrix& M, double floor);

/// Cotangent of M from the cotangent of fit_inverse(M).
FitMatrix fit_inverse_vjp(const FitMatrix& M, const FitInverse& inverse_bar, double floor);

}  // namespace diffcloth::mesh
