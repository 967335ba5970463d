// Kernel of SquaredDistances, written once over packs of `kPack` doubles. A pack holds one number of
// each of kPack pairs. In place of the branches of distance/separation.cpp, all results are computed
// here and one is selected. Everything is in an anonymous namespace, for the reason given in
// linalg/dense_kernels_impl.h.

#pragma once

#include "contact/separation_lanes.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::contact {
namespace {

using Pack = double __attribute__((vector_size(8 * kPack)));
using Stored = double __attribute__((vector_size(8 * kPack), may_alias));
using Mask = long long __attribute__((vector_size(8 * kPack)));

/// See distance/separation.cpp.
constexpr double kSliver = 1e-6;

struct Vectors {
  Pack v[3];
};

DIFFCLOTH_INLINE Vectors operator-(const Vectors& a, const Vectors& b) {
  return {{a.v[0] - b.v[0], a.v[1] - b.v[1], a.v[2] - b.v[2]}};
}
DIFFCLOTH_INLINE Pack dot(const Vectors& a, const Vectors& b) {
  return a.v[0] * b.v[0] + a.v[1] * b.v[1] + a.v[2] * b.v[2];
}
DIFFCLOTH_INLINE Vectors cross(const Vectors& a, const Vectors& b) {
  return {{a.v[1] * b.v[2] - a.v[2] * b.v[1], a.v[2] * b.v[0] - a.v[0] * b.v[2],
           a.v[0] * b.v[1] - a.v[1] * b.v[0]}};
}
/// w - a e
DIFFCLOTH_INLINE Vectors less(const Vectors& w, const Pack& a, const Vectors& e) {
  return {{w.v[0] - a * e.v[0], w.v[1] - a * e.v[1], w.v[2] - a * e.v[2]}};
}
DIFFCLOTH_INLINE Pack square(const Vectors& a) { return dot(a, a); }
DIFFCLOTH_INLINE Pack smaller(const Pack& a, const Pack& b) { return b < a ? b : a; }

/// The parameters in [0, 1] nearest to numerator / denominator; 0 on an edge of no length.
DIFFCLOTH_INLINE Pack clamped_ratio(const Pack& numerator, const Pack& denominator) {
  Pack ratio = numerator / denominator;
  ratio = ratio < 0.0 ? Pack{} : ratio;
  ratio = ratio > 1.0 ? Pack{} + 1.0 : ratio;
  return denominator > 0.0 ? ratio : Pack{};
}

/// Squared distance of the point w from the segment that starts at the origin with direction e.
DIFFCLOTH_INLINE Pack from_segment(const Vectors& w, const Vectors& e) {
  return square(less(w, clamped_ratio(dot(w, e), dot(e, e)), e));
}

DIFFCLOTH_INLINE Pack from_triangle(const Vectors (&x)[4]) {
  const Vectors e0 = x[2] - x[1];
  const Vectors e1 = x[3] - x[1];
  const Vectors w = x[0] - x[1];
  const Vectors n = cross(e0, e1);
  const Pack n_sq = square(n);
  Pack b0 = dot(cross(w, e1), n) / n_sq;
  Pack b1 = dot(cross(e0, w), n) / n_sq;
  const Mask is_sliver = n_sq < kSliver * dot(e0, e0) * dot(e1, e1);
  // In slivers b0 and b1 have an error of rounding / sin(angle): one step of iterative refinement.
  const Vectors rest = less(less(w, b0, e0), b1, e1);
  b0 = is_sliver ? b0 + dot(cross(rest, e1), n) / n_sq : b0;
  b1 = is_sliver ? b1 + dot(cross(e0, rest), n) / n_sq : b1;
  const Mask is_inside = (n_sq > 0.0) & (b0 >= 0.0) & (b1 >= 0.0) & (b0 + b1 <= 1.0);
  const Pack inside = square(less(less(w, b0, e0), b1, e1));
  Pack best = square(w);
  best = is_inside ? smaller(best, inside) : best;
  best = smaller(best, from_segment(w, e0));
  best = smaller(best, from_segment(w, e1));
  best = smaller(best, from_segment(x[0] - x[2], x[3] - x[2]));
  return (is_inside & ~is_sliver) ? inside : best;
}

DIFFCLOTH_INLINE Pack between_edges(const Vectors (&x)[4]) {
  const Vectors u = x[1] - x[0];
  const Vectors v = x[3] - x[2];
  const Vectors w = x[0] - x[2];
  const Vectors n = cross(u, v);
  const Pack n_sq = square(n);
  const Pack uu = dot(u, u);
  const Pack vv = dot(v, v);
  const Pack uv = dot(u, v);
  const Pack uw = dot(u, w);
  const Pack vw = dot(v, w);
  const auto at = [&](const Pack& s, const Pack& t) { return square(less(less(w, -s, u), t, v)); };
  const Pack s = dot(cross(v, w), n) / n_sq;
  const Pack t = (vw + s * uv) / vv;
  const Mask is_between = (n_sq > 0.0) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0);
  const Pack zero = {};
  const Pack one = zero + 1.0;
  Pack best = square(w);
  best = smaller(best, at(zero, clamped_ratio(vw, vv)));
  best = smaller(best, at(one, clamped_ratio(vw + uv, vv)));
  best = smaller(best, at(clamped_ratio(-uw, uu), zero));
  best = smaller(best, at(clamped_ratio(uv - uw, uu), one));
  return is_between ? at(s, t) : best;
}

void find_squared_distances(bool edges,
                            const double* x,
                            const std::int32_t* corners,
                            std::ptrdiff_t stride,
                            std::ptrdiff_t count,
                            double* d_sq) {
  for (std::ptrdiff_t first = 0; first < count; first += kPack) {
    const std::ptrdiff_t left = count - first;
    alignas(8 * kPack) double at[4][3][kPack];
    for (int l = 0; l < kPack; ++l) {
      // Lanes beyond the last pair repeat it.
      const std::int32_t* const pair = corners + stride * (first + (l < left ? l : left - 1));
      for (int i = 0; i < 4; ++i) {
        const double* const from = x + 3 * static_cast<std::ptrdiff_t>(pair[i]);
        for (int k = 0; k < 3; ++k) at[i][k][l] = from[k];
      }
    }
    Vectors corner[4];
    for (int i = 0; i < 4; ++i) {
      for (int k = 0; k < 3; ++k) corner[i].v[k] = *reinterpret_cast<const Stored*>(at[i][k]);
    }
    const Pack found = edges ? between_edges(corner) : from_triangle(corner);
    for (int l = 0; l < kPack && l < left; ++l) d_sq[first + l] = found[l];
  }
}

constexpr SquaredDistances kKernels = find_squared_distances;

}  // namespace
}  // namespace diffcloth::contact

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
