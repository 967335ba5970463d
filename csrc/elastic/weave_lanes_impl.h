// Symmetric matrices and the stiffnesses of woven triangles in lanes: see weave.h and stretch_lanes_impl.h.

#pragma once

#include "elastic/polar_lanes_impl.h"
#include "elastic/stretch_lanes.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

/// A symmetric matrix in the axes of a triangle.
struct Symmetric {
  double uu, uv, vv;
};

DIFFCLOTH_INLINE Symmetric sum(const Symmetric& A, const Symmetric& B) {
  return {.uu = A.uu + B.uu, .uv = A.uv + B.uv, .vv = A.vv + B.vv};
}

/// <A, B>.
DIFFCLOTH_INLINE double product(const Symmetric& A, const Symmetric& B) {
  return A.uu * B.uu + 2.0 * (A.uv * B.uv) + A.vv * B.vv;
}

/// The positive semi-definite part.
DIFFCLOTH_INLINE Symmetric positive_part(const Symmetric& A) {
  const double mean = 0.5 * (A.uu + A.vv);
  const double half = 0.5 * (A.uu - A.vv);
  const double radius = __builtin_sqrt(half * half + A.uv * A.uv);
  const bool all = mean - radius >= 0.0;
  const bool none = mean + radius <= 0.0;
  // If only a part is positive, the radius is positive.
  const double larger_one = 0.5 * (mean + radius);
  const double scale = larger_one / radius;
  const double uu = larger_one + scale * half;
  const double uv = scale * A.uv;
  const double vv = larger_one - scale * half;
  return {.uu = all ? A.uu : (none ? 0.0 : uu),
          .uv = all ? A.uv : (none ? 0.0 : uv),
          .vv = all ? A.vv : (none ? 0.0 : vv)};
}

/// A^T B + C^T A: the change of F^T F for a change A of F, from C to B.
DIFFCLOTH_INLINE Symmetric change_of_square(const Gradient& A,
                                            const Gradient& B,
                                            const Gradient& C) {
  return {.uu = dot(A.a, B.a) + dot(C.a, A.a),
          .uv = dot(A.a, B.b) + dot(C.a, A.b),
          .vv = dot(A.b, B.b) + dot(C.b, A.b)};
}

/// K of one lane, times the area.
struct Stiffness {
  double warp, shear, weft;
};

DIFFCLOTH_INLINE Stiffness stiffness_of(const WovenBatch& batch, int l) {
  return {
      .warp = batch.stiffness[0][l], .shear = batch.stiffness[1][l], .weft = batch.stiffness[2][l]};
}

/// K o A.
DIFFCLOTH_INLINE Symmetric times(const Stiffness& K, const Symmetric& A) {
  return {.uu = K.warp * A.uu, .uv = K.shear * A.uv, .vv = K.weft * A.vv};
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
