#pragma once

#include <array>

#include "common/types.h"

namespace diffcloth::bodies {

/// The matrix v with v y = a x y.
inline Mat3 cross_matrix(const Vec3& a) {
  Mat3 m;
  m << 0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0;
  return m;
}

/// R(w) = exp(w x) of a rotation vector [rad], with its first and second derivatives; smooth at zero.
struct Exponential {
  explicit Exponential(const Vec3& w);

  Mat3 value;
  std::array<Mat3, 3> first;                  ///< dR/dw_i
  std::array<std::array<Mat3, 3>, 3> second;  ///< d2R/dw_i dw_j
};

}  // namespace diffcloth::bodies
