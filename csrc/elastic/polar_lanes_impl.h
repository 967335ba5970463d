// The frames of triangles, shared by all files with arithmetic in lanes: see stretch_lanes_impl.h.

#pragma once

#include "elastic/degenerate.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

DIFFCLOTH_INLINE double larger(double a, double b) { return a > b ? a : b; }
DIFFCLOTH_INLINE double smaller(double a, double b) { return a < b ? a : b; }

/// The two columns of F of one lane.
struct Gradient {
  double a[3], b[3];
};

DIFFCLOTH_INLINE double dot(const double* a, const double* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/// See Frame in frame.h.
struct Polar {
  double r1[3], r2[3], n[3];
  double c11, c12, c22;
  double s11, s12, s22;  ///< S^-1
  double t, d;           ///< d is not floored
};

DIFFCLOTH_INLINE Polar polar_of(const Gradient& F) {
  Polar p;
  double normal[3];
  normal[0] = F.a[1] * F.b[2] - F.a[2] * F.b[1];
  normal[1] = F.a[2] * F.b[0] - F.a[0] * F.b[2];
  normal[2] = F.a[0] * F.b[1] - F.a[1] * F.b[0];
  p.c11 = dot(F.a, F.a);
  p.c12 = dot(F.a, F.b);
  p.c22 = dot(F.b, F.b);
  p.d = __builtin_sqrt(dot(normal, normal));
  const double d = larger(p.d, kDegenerate);
  p.t = larger(__builtin_sqrt(p.c11 + p.c22 + 2.0 * p.d), kDegenerate);
  const double scale = 1.0 / (d * p.t);
  p.s11 = (p.c22 + d) * scale;
  p.s12 = -p.c12 * scale;
  p.s22 = (p.c11 + d) * scale;
  const double inv_d = 1.0 / d;
  for (int k = 0; k < 3; ++k) {
    p.r1[k] = F.a[k] * p.s11 + F.b[k] * p.s12;
    p.r2[k] = F.a[k] * p.s12 + F.b[k] * p.s22;
    p.n[k] = normal[k] * inv_d;
  }
  return p;
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
