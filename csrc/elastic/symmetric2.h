#pragma once

#include <cmath>

#include "common/types.h"

namespace diffcloth::elastic {

inline Mat2 symmetric_part(const Mat2& A) { return 0.5 * (A + A.transpose()); }

/// A symmetric 2x2 matrix with its eigenvalues clamped to at least 0.
inline Mat2 positive_part(const Mat2& A) {
  const double mean = 0.5 * (A(0, 0) + A(1, 1));
  const double half = 0.5 * (A(0, 0) - A(1, 1));
  const double radius = std::hypot(half, A(0, 1));
  if (mean - radius >= 0.0) return A;
  if (mean + radius <= 0.0) return Mat2::Zero();
  // Here radius > 0. A = mean I + D with D^2 = radius^2 I: rescale D about the clamped mean.
  const double high = mean + radius;
  Mat2 result = 0.5 * high / radius * (A - mean * Mat2::Identity());
  result.diagonal().array() += 0.5 * high;
  return result;
}

}  // namespace diffcloth::elastic
