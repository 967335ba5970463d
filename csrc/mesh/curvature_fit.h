#pragma once

#include <array>
#include <numbers>

#include <Eigen/Core>

#include "common/types.h"

namespace diffcloth::mesh {

/// Most vertices that a patch can have: its triangle, three neighbors, and two more for each.
inline constexpr int kMaxPatch = 12;
inline constexpr int kMaxExtra = kMaxPatch - 3;

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

/// Rows of the fit, one an extra point; at least three (rows of zeros change nothing).
using FitMatrix = Eigen::Matrix<double, Eigen::Dynamic, 3, 0, kMaxExtra, 3>;
using FitInverse = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, kMaxExtra>;

/// Smallest singular value of the fit below which a patch takes the second ring, and the size
/// below which a singular value counts as zero.
inline constexpr double kWellPosed = 0.15;
inline constexpr double kRankFloor = 0.08;

double smallest_singular_value(const FitMatrix& M);

/// Smooth pseudo-inverse: V f(S) U^T of M = U S V^T with f(s) = s^7 / (s^8 + kRankFloor^8).
///
/// f is odd and analytic, so the inverse is smooth in M also where the rank changes, and a
/// direction that the points do not determine (a strip one triangle wide) stays undetermined to
/// first order. Where the fit is well posed, f differs from 1/s by less than 0.7 %, and by less
/// than 3e-5 from s = 0.3 on.
FitInverse fit_inverse(const FitMatrix& M);

/// Cotangent of M from the cotangent of fit_inverse(M).
FitMatrix fit_inverse_vjp(const FitMatrix& M, const FitInverse& inverse_bar);

}  // namespace diffcloth::mesh
