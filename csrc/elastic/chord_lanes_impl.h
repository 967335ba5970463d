// The arithmetic of elastic/chord_strain.h in lanes: see stretch_lanes_impl.h.

#pragma once

#include <cstddef>
#include <cstdint>

#include "elastic/face_lanes_impl.h"
#include "elastic/weave_lanes_impl.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

/// sym(G^T D).
DIFFCLOTH_INLINE Symmetric strain_along(const Gradient& G, const Gradient& D) {
  return {.uu = dot(G.a, D.a), .uv = 0.5 * (dot(G.a, D.b) + dot(G.b, D.a)), .vv = dot(G.b, D.b)};
}

/// e of one lane.
DIFFCLOTH_INLINE Symmetric chord_strain(const ChordBatch& batch,
                                        const Gradient& F,
                                        const Gradient& D,
                                        int l) {
  Gradient G;
  for (int k = 0; k < 3; ++k) {
    G.a[k] = F.a[k] - batch.center[k][l];
    G.b[k] = F.b[k] - batch.center[3 + k][l];
  }
  return strain_along(G, D);
}

/// D A.
DIFFCLOTH_INLINE Gradient times(const Gradient& D, const Symmetric& A) {
  Gradient result;
  for (int k = 0; k < 3; ++k) {
    result.a[k] = D.a[k] * A.uu + D.b[k] * A.uv;
    result.b[k] = D.a[k] * A.uv + D.b[k] * A.vv;
  }
  return result;
}

double chord_energy(const ChordBatch* batches, std::size_t count, const double* x) {
  double total = 0.0;
  for (const ChordBatch* batch = batches; batch != batches + count; ++batch) {
    Sides sides;
    gather_sides(batch->faces, x, sides);
    alignas(64) double energy[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient D = gradient_of(batch->shift, l);
      const Symmetric e = chord_strain(*batch, gradient(batch->faces, sides, l), D, l);
      const double q = product(e, e);
      energy[l] = (0.5 * batch->weight[l]) * (q * q) / (q + kFreeStrainSq);
    }
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

double chord_energy_change(const ChordBatch* batches,
                           std::size_t count,
                           const double* x0,
                           const double* x1) {
  double total = 0.0;
  for (const ChordBatch* batch = batches; batch != batches + count; ++batch) {
    Motion motion;
    gather_motion(batch->faces, x0, x1, motion);
    alignas(64) double energy[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient D = gradient_of(batch->shift, l);
      const Symmetric e0 = chord_strain(*batch, gradient(batch->faces, motion.start, l), D, l);
      const Symmetric e1 = chord_strain(*batch, gradient(batch->faces, motion.end, l), D, l);
      const Symmetric de = strain_along(gradient(batch->faces, motion.change, l), D);
      const double q0 = product(e0, e0);
      const double q1 = product(e1, e1);
      const double dq = product(de, sum(e0, e1));
      energy[l] = (0.5 * batch->weight[l]) * dq * (q0 * q1 + kFreeStrainSq * (q0 + q1)) /
                  ((q0 + kFreeStrainSq) * (q1 + kFreeStrainSq));
    }
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

void add_chord_gradient(const ChordBatch* batches, std::size_t count, const double* x, double* g) {
  for (const ChordBatch* batch = batches; batch != batches + count; ++batch) {
    const FaceBatch& faces = batch->faces;
    Sides sides;
    gather_sides(faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient D = gradient_of(batch->shift, l);
      const Symmetric e = chord_strain(*batch, gradient(faces, sides, l), D, l);
      const double q = product(e, e);
      const double sum = q + kFreeStrainSq;
      const double scale = batch->weight[l] * (q * (q + 2.0 * kFreeStrainSq)) / (sum * sum);
      const Gradient P = times(D, e);
      for (int k = 0; k < 3; ++k) {
        put_forces(faces, k, scale * P.a[k], scale * P.b[k], l, force);
      }
    }
    scatter_forces(faces, force, g);
  }
}

DIFFCLOTH_INLINE void chord_hessians(const ChordBatch& batch,
                                     const double* x,
                                     double (&h)[54][kLanes]) {
  const FaceBatch& faces = batch.faces;
  Sides sides;
  gather_sides(faces, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    const Gradient D = gradient_of(batch.shift, l);
    const Symmetric e = chord_strain(batch, gradient(faces, sides, l), D, l);
    const double q = product(e, e);
    const double sum = q + kFreeStrainSq;
    const double w = batch.weight[l] / (sum * sum);
    const double first = 0.5 * w * (q * (q + 2.0 * kFreeStrainSq));
    const double second = 4.0 * w * (kFreeStrainSq * kFreeStrainSq) / sum;
    const Gradient De = times(D, e);
    const double u[3] = {-(faces.g[0][l] + faces.g[2][l]), faces.g[0][l], faces.g[2][l]};
    const double v[3] = {-(faces.g[1][l] + faces.g[3][l]), faces.g[1][l], faces.g[3][l]};
    double turned[3][3];
    double along[3][3];
#pragma GCC unroll 3
    for (int p = 0; p < 3; ++p) {
#pragma GCC unroll 3
      for (int a = 0; a < 3; ++a) {
        turned[p][a] = D.a[a] * u[p] + D.b[a] * v[p];
        along[p][a] = De.a[a] * u[p] + De.b[a] * v[p];
      }
    }
    int k = 0;
#pragma GCC unroll 3
    for (int p = 0; p < 3; ++p) {
#pragma GCC unroll 3
      for (int r = 0; r <= p; ++r, k += 9) {
        const double both = u[p] * u[r] + v[p] * v[r];
#pragma GCC unroll 3
        for (int b = 0; b < 3; ++b) {
#pragma GCC unroll 3
          for (int a = 0; a < 3; ++a) {
            const double square = D.a[a] * D.a[b] + D.b[a] * D.b[b];
            h[k + a + 3 * b][l] = first * (both * square + turned[r][a] * turned[p][b]) +
                                  second * (along[p][a] * along[r][b]);
          }
        }
      }
    }
  }
}

void add_chord_hessian(const ChordBatch* batches,
                       std::size_t count,
                       const double* x,
                       const std::int32_t* place,
                       double* blocks) {
  add_hessians(
      batches, count, x, false, place, blocks,
      [](const ChordBatch& batch) -> const FaceBatch& { return batch.faces; }, chord_hessians,
      chord_hessians);
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
