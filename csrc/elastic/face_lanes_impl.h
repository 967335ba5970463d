// Triangles in lanes: their sides, forces on their corners and blocks. See stretch_lanes_impl.h.

#pragma once

#include <cstddef>
#include <cstdint>

#include "elastic/block_lanes_impl.h"
#include "elastic/polar_lanes_impl.h"
#include "elastic/stretch_lanes.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

constexpr int kLanes = kStretchLanes;

/// Two vectors along the sides of each triangle, from corner 0 to corners 1 and 2.
struct Sides {
  alignas(64) double at[6][kLanes];
};

DIFFCLOTH_INLINE void gather_sides(const FaceBatch& batch, const double* x, Sides& sides) {
  for (int l = 0; l < kLanes; ++l) {
    const double* const x0 = x + 3 * static_cast<std::ptrdiff_t>(batch.vertex[0][l]);
    const double* const x1 = x + 3 * static_cast<std::ptrdiff_t>(batch.vertex[1][l]);
    const double* const x2 = x + 3 * static_cast<std::ptrdiff_t>(batch.vertex[2][l]);
    for (int k = 0; k < 3; ++k) {
      sides.at[k][l] = x1[k] - x0[k];
      sides.at[3 + k][l] = x2[k] - x0[k];
    }
  }
}

/// The sides of x1 - x0, from differences of positions.
DIFFCLOTH_INLINE void gather_change(const FaceBatch& batch,
                                    const double* x0,
                                    const double* x1,
                                    Sides& sides) {
  for (int l = 0; l < kLanes; ++l) {
    const std::ptrdiff_t i = 3 * static_cast<std::ptrdiff_t>(batch.vertex[0][l]);
    const std::ptrdiff_t j = 3 * static_cast<std::ptrdiff_t>(batch.vertex[1][l]);
    const std::ptrdiff_t m = 3 * static_cast<std::ptrdiff_t>(batch.vertex[2][l]);
    for (int k = 0; k < 3; ++k) {
      const double origin = x1[i + k] - x0[i + k];
      sides.at[k][l] = (x1[j + k] - x0[j + k]) - origin;
      sides.at[3 + k][l] = (x1[m + k] - x0[m + k]) - origin;
    }
  }
}

/// The sides at both ends of a motion, and their change.
struct Motion {
  Sides start, end, change;
};

DIFFCLOTH_INLINE void gather_motion(const FaceBatch& batch,
                                    const double* x0,
                                    const double* x1,
                                    Motion& motion) {
  gather_sides(batch, x0, motion.start);
  gather_sides(batch, x1, motion.end);
  gather_change(batch, x0, x1, motion.change);
}

DIFFCLOTH_INLINE Gradient gradient(const FaceBatch& batch, const Sides& sides, int l) {
  Gradient F;
  for (int k = 0; k < 3; ++k) {
    F.a[k] = sides.at[k][l] * batch.g[0][l] + sides.at[3 + k][l] * batch.g[2][l];
    F.b[k] = sides.at[k][l] * batch.g[1][l] + sides.at[3 + k][l] * batch.g[3][l];
  }
  return F;
}

/// A gradient that a batch stores, column by column.
DIFFCLOTH_INLINE Gradient gradient_of(const double (&columns)[6][kLanes], int l) {
  Gradient F;
  for (int k = 0; k < 3; ++k) {
    F.a[k] = columns[k][l];
    F.b[k] = columns[3 + k][l];
  }
  return F;
}

/// Forces of a triangle on its corners 1 and 2, from component k of its stress, columns a and b.
DIFFCLOTH_INLINE void put_forces(
    const FaceBatch& batch, int k, double a, double b, int l, double (&force)[6][kLanes]) {
  force[k][l] = a * batch.g[0][l] + b * batch.g[1][l];
  force[3 + k][l] = a * batch.g[2][l] + b * batch.g[3][l];
}

/// Add forces on corners 1 and 2, and their reaction on corner 0.
DIFFCLOTH_INLINE void scatter_forces(const FaceBatch& batch,
                                     const double (&force)[6][kLanes],
                                     double* g) {
  for (int l = 0; l < batch.size; ++l) {
    double* const g0 = g + 3 * static_cast<std::ptrdiff_t>(batch.vertex[0][l]);
    double* const g1 = g + 3 * static_cast<std::ptrdiff_t>(batch.vertex[1][l]);
    double* const g2 = g + 3 * static_cast<std::ptrdiff_t>(batch.vertex[2][l]);
    for (int k = 0; k < 3; ++k) {
      g0[k] -= force[k][l] + force[3 + k][l];
      g1[k] += force[k][l];
      g2[k] += force[3 + k][l];
    }
  }
}

DIFFCLOTH_INLINE void scatter_blocks(const FaceBatch& batch,
                                     const double (&h)[54][kLanes],
                                     const std::int32_t* place,
                                     double* blocks) {
  for (int k = 0; k < 6; ++k) add_blocks(h + 9 * k, batch.slot[k], batch.size, place, blocks);
}

/// blocks += the Hessians of batches, exact or projected.
///
/// @param faces  (batch) -> its triangles
/// @param exact  (batch, x, h) writes the blocks of a batch; `projected` likewise
template <class Batch, class Faces, class Exact, class Projected>
DIFFCLOTH_INLINE void add_hessians(const Batch* batches,
                                   std::size_t count,
                                   const double* x,
                                   bool positive,
                                   const std::int32_t* place,
                                   double* blocks,
                                   Faces faces,
                                   Exact exact,
                                   Projected projected) {
  alignas(64) double h[54][kLanes];
  for (const Batch* batch = batches; batch != batches + count; ++batch) {
    if (positive) {
      projected(*batch, x, h);
    } else {
      exact(*batch, x, h);
    }
    scatter_blocks(faces(*batch), h, place, blocks);
  }
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
