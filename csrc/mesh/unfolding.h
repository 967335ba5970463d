#pragma once

#include <array>
#include <cmath>

#include "common/types.h"

namespace diffcloth::mesh {

/// A triangle of the rest mesh in its own frame: corners at (0, 0), (length, 0), (a, b).
template <class Scalar>
struct BaseTriangle {
  Scalar length, a, b;
  std::array<Scalar, 9> frame;  ///< r1, r2, n
};

/// @param X  the three corners, one after the other
template <class Scalar>
BaseTriangle<Scalar> base_triangle(const std::array<Scalar, 9>& X) {
  using std::sqrt;
  std::array<Scalar, 3> r1, r2, n, side;
  for (int k = 0; k < 3; ++k) {
    r1[k] = X[3 + k] - X[k];
    side[k] = X[6 + k] - X[k];
  }
  const Scalar length = sqrt(r1[0] * r1[0] + r1[1] * r1[1] + r1[2] * r1[2]);
  for (Scalar& c : r1) c = c / length;
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    n[k] = r1[i] * side[j] - r1[j] * side[i];
  }
  const Scalar height = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
  for (Scalar& c : n) c = c / height;
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    r2[k] = n[i] * r1[j] - n[j] * r1[i];
  }
  const Scalar a = r1[0] * side[0] + r1[1] * side[1] + r1[2] * side[2];
  return {.length = length,
          .a = a,
          .b = height,
          .frame = {r1[0], r1[1], r1[2], r2[0], r2[1], r2[2], n[0], n[1], n[2]}};
}

/// Position of the third corner of a triangle relative to its edge a -> b, in edge lengths: `along` the
/// edge from a, and `off` to its side.
template <class Scalar>
struct Foot {
  Scalar along, off;
};

/// @param X  the corners a, b and the third corner
template <class Scalar>
Foot<Scalar> unfold(const std::array<Scalar, 9>& X) {
  using std::sqrt;
  std::array<Scalar, 3> edge, side;
  for (int k = 0; k < 3; ++k) {
    edge[k] = X[3 + k] - X[k];
    side[k] = X[6 + k] - X[k];
  }
  const Scalar length_sq = edge[0] * edge[0] + edge[1] * edge[1] + edge[2] * edge[2];
  const Scalar along = (edge[0] * side[0] + edge[1] * side[1] + edge[2] * side[2]) / length_sq;
  std::array<Scalar, 3> n;
  for (int k = 0; k < 3; ++k) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    n[k] = edge[i] * side[j] - edge[j] * side[i];
  }
  return {.along = along, .off = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) / length_sq};
}

/// The point at the given foot to the right of the edge a -> b of the plane.
inline Vec2 place(const Vec2& a, const Vec2& b, const Foot<double>& foot) {
  const Vec2 edge = b - a;
  return a + foot.along * edge + foot.off * Vec2(edge.y(), -edge.x());
}

}  // namespace diffcloth::mesh
