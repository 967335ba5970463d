// The arithmetic of the damping of StretchKernels: see stretch_lanes_impl.h.

#pragma once

#include <cstddef>
#include <cstdint>

#include "elastic/face_lanes_impl.h"
#include "elastic/weave_lanes_impl.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

/// C - C_n, with a prediction C - C_n + kAhead (C_a - C_n).
DIFFCLOTH_INLINE Symmetric strain_of(const DampingBatch& batch, const Gradient& F, int l) {
  const Gradient F_n = gradient_of(batch.start, l);
  Gradient dF;
  for (int k = 0; k < 3; ++k) {
    dF.a[k] = F.a[k] - F_n.a[k];
    dF.b[k] = F.b[k] - F_n.b[k];
  }
  const Symmetric since_start = change_of_square(dF, F, F_n);
  return {.uu = since_start.uu + batch.gained[0][l],
          .uv = since_start.uv + batch.gained[1][l],
          .vv = since_start.vv + batch.gained[2][l]};
}

/// Forces of a triangle on its corners 1 and 2, by its strain since the start of the step.
DIFFCLOTH_INLINE void put_damping_force(const DampingBatch& batch,
                                        const Gradient& F,
                                        const Symmetric& strain,
                                        int l,
                                        double (&force)[6][kLanes]) {
  const FaceBatch& faces = batch.woven.faces;
  const Symmetric T = times(stiffness_of(batch.woven, l), strain);
  for (int k = 0; k < 3; ++k) {
    const double a = 0.5 * (F.a[k] * T.uu + F.b[k] * T.uv);
    const double b = 0.5 * (F.a[k] * T.uv + F.b[k] * T.vv);
    put_forces(faces, k, a, b, l, force);
  }
}

double damping_energy_change(const DampingBatch* batches,
                             std::size_t count,
                             const double* x0,
                             const double* x1,
                             double* g1) {
  double total = 0.0;
  for (const DampingBatch* batch = batches; batch != batches + count; ++batch) {
    const FaceBatch& faces = batch->woven.faces;
    Motion motion;
    gather_motion(faces, x0, x1, motion);
    alignas(64) double energy[kLanes];
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F0 = gradient(faces, motion.start, l);
      const Gradient F1 = gradient(faces, motion.end, l);
      const Symmetric dC = change_of_square(gradient(faces, motion.change, l), F1, F0);
      const Symmetric strain = strain_of(*batch, F1, l);
      const Symmetric twice_mean = sum(strain_of(*batch, F0, l), strain);
      energy[l] = 0.125 * product(times(stiffness_of(batch->woven, l), twice_mean), dC);
      put_damping_force(*batch, F1, strain, l, force);
    }
    if (g1 != nullptr) scatter_forces(faces, force, g1);
    for (int l = 0; l < faces.size; ++l) total += energy[l];
  }
  return total;
}

void add_damping_gradient(const DampingBatch* batches,
                          std::size_t count,
                          const double* x,
                          double* g) {
  for (const DampingBatch* batch = batches; batch != batches + count; ++batch) {
    const FaceBatch& faces = batch->woven.faces;
    Sides sides;
    gather_sides(faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(faces, sides, l);
      put_damping_force(*batch, F, strain_of(*batch, F, l), l, force);
    }
    scatter_forces(faces, force, g);
  }
}

template <bool Positive>
DIFFCLOTH_INLINE void damping_hessians(const DampingBatch& batch,
                                       const double* x,
                                       double (&h)[54][kLanes]) {
  const FaceBatch& faces = batch.woven.faces;
  Sides sides;
  gather_sides(faces, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    const Gradient F = gradient(faces, sides, l);
    const Stiffness K = stiffness_of(batch.woven, l);
    const Symmetric exact = times(K, strain_of(batch, F, l));
    const Symmetric T = Positive ? positive_part(exact) : exact;
    const double u[3] = {-(faces.g[0][l] + faces.g[2][l]), faces.g[0][l], faces.g[2][l]};
    const double v[3] = {-(faces.g[1][l] + faces.g[3][l]), faces.g[1][l], faces.g[3][l]};
    const double shear = 0.5 * K.shear;
    int k = 0;
#pragma GCC unroll 3
    for (int p = 0; p < 3; ++p) {
#pragma GCC unroll 3
      for (int q = 0; q <= p; ++q, k += 9) {
        const double m_uu = K.warp * (u[p] * u[q]) + shear * (v[p] * v[q]);
        const double m_uv = shear * (v[p] * u[q]);
        const double m_vu = shear * (u[p] * v[q]);
        const double m_vv = K.weft * (v[p] * v[q]) + shear * (u[p] * u[q]);
        const double diagonal =
            0.5 * (u[p] * (T.uu * u[q] + T.uv * v[q]) + v[p] * (T.uv * u[q] + T.vv * v[q]));
#pragma GCC unroll 3
        for (int b = 0; b < 3; ++b) {
          const double of_u = m_uu * F.a[b] + m_uv * F.b[b];
          const double of_v = m_vu * F.a[b] + m_vv * F.b[b];
#pragma GCC unroll 3
          for (int a = 0; a < 3; ++a) {
            h[k + a + 3 * b][l] = F.a[a] * of_u + F.b[a] * of_v + (a == b ? diagonal : 0.0);
          }
        }
      }
    }
  }
}

void add_damping_hessian(const DampingBatch* batches,
                         std::size_t count,
                         const double* x,
                         bool positive,
                         const std::int32_t* place,
                         double* blocks) {
  add_hessians(
      batches, count, x, positive, place, blocks,
      [](const DampingBatch& batch) -> const FaceBatch& { return batch.woven.faces; },
      damping_hessians<false>, damping_hessians<true>);
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
