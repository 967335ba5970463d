// The arithmetic of StretchKernels, in a single implementation. Loops over lanes are plain loops, which
// compilers turn into the instructions that a file is compiled for. Everything here is in an anonymous
// namespace, for the reason given in linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>

#include "elastic/chord_lanes_impl.h"
#include "elastic/damping_lanes_impl.h"
#include "elastic/degenerate.h"
#include "elastic/face_lanes_impl.h"
#include "elastic/woven_lanes_impl.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

/// |F - R|^2, in a form that needs no frame for nearly degenerate triangles.
DIFFCLOTH_INLINE double strain_sq(const Gradient& F, const Polar& p) {
  double regular = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double a = F.a[k] - p.r1[k];
    const double b = F.b[k] - p.r2[k];
    regular += a * a + b * b;
  }
  const double degenerate = p.c11 + p.c22 - 2.0 * p.t + 2.0;
  return p.d >= kNearlyDegenerate ? regular : degenerate;
}

/// Forces of a triangle on its corners 1 and 2.
DIFFCLOTH_INLINE void put_force(const StretchBatch& batch,
                                const Gradient& F,
                                const Polar& p,
                                int l,
                                double (&force)[6][kLanes]) {
  for (int k = 0; k < 3; ++k) {
    const double a = batch.weight[l] * (F.a[k] - p.r1[k]);
    const double b = batch.weight[l] * (F.b[k] - p.r2[k]);
    put_forces(batch.faces, k, a, b, l, force);
  }
}

double energy_change(const StretchBatch* batches,
                     std::size_t count,
                     const double* x0,
                     const double* x1,
                     double* g1) {
  double total = 0.0;
  for (const StretchBatch* batch = batches; batch != batches + count; ++batch) {
    Motion motion;
    gather_motion(batch->faces, x0, x1, motion);
    alignas(64) double energy[kLanes];
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F0 = gradient(batch->faces, motion.start, l);
      const Gradient F1 = gradient(batch->faces, motion.end, l);
      const Gradient dF = gradient(batch->faces, motion.change, l);
      const Polar p0 = polar_of(F0);
      const Polar p1 = polar_of(F1);
      double work = 0.0;
      double dr1[3];
      double dr2[3];
      for (int k = 0; k < 3; ++k) {
        work += ((F0.a[k] - p0.r1[k]) + (F1.a[k] - p1.r1[k])) * dF.a[k];
        work += ((F0.b[k] - p0.r2[k]) + (F1.b[k] - p1.r2[k])) * dF.b[k];
        dr1[k] = p1.r1[k] - p0.r1[k];
        dr2[k] = p1.r2[k] - p0.r2[k];
      }
      const double inv_t0 = 1.0 / p0.t;
      const double inv_t1 = 1.0 / p1.t;
      const double dS_uu = (p1.c11 + p1.d) * inv_t1 - (p0.c11 + p0.d) * inv_t0;
      const double dS_uv = p1.c12 * inv_t1 - p0.c12 * inv_t0;
      const double dS_vv = (p1.c22 + p1.d) * inv_t1 - (p0.c22 + p0.d) * inv_t0;
      const double turned =
          dS_uu * dot(dr1, dr1) + 2.0 * (dS_uv * dot(dr1, dr2)) + dS_vv * dot(dr2, dr2);
      const double regular = work - 0.5 * turned;
      const double difference = strain_sq(F1, p1) - strain_sq(F0, p0);
      const bool is_regular = smaller(p0.d, p1.d) >= kNearlyDegenerate;
      energy[l] = (0.5 * batch->weight[l]) * (is_regular ? regular : difference);
      put_force(*batch, F1, p1, l, force);
    }
    if (g1 != nullptr) scatter_forces(batch->faces, force, g1);
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

void add_gradient(const StretchBatch* batches, std::size_t count, const double* x, double* g) {
  for (const StretchBatch* batch = batches; batch != batches + count; ++batch) {
    Sides sides;
    gather_sides(batch->faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(batch->faces, sides, l);
      put_force(*batch, F, polar_of(F), l, force);
    }
    scatter_forces(batch->faces, force, g);
  }
}

/// Clamp 1/t to 1/2, and the eigenvalues of S^-1 to 1.
DIFFCLOTH_INLINE void project(Polar& p, double& inv_t) {
  inv_t = smaller(inv_t, 0.5);
  const double mean = 0.5 * (p.s11 + p.s22);
  const double half = 0.5 * (p.s11 - p.s22);
  const double radius = __builtin_sqrt(half * half + p.s12 * p.s12);
  const double low = mean - radius;
  // Three cases: the matrix itself; the identity; only the larger eigenvalue lowered to 1, with radius >
  // 0.
  const bool below = mean + radius <= 1.0;
  const bool above = low >= 1.0;
  const double scale = 0.5 * (1.0 - low) / radius;
  const double middle = 0.5 * (1.0 + low);
  const double s11 = scale * half + middle;
  const double s12 = scale * p.s12;
  const double s22 = middle - scale * half;
  p.s11 = below ? p.s11 : (above ? 1.0 : s11);
  p.s12 = below ? p.s12 : (above ? 0.0 : s12);
  p.s22 = below ? p.s22 : (above ? 1.0 : s22);
}

template <bool Positive>
DIFFCLOTH_INLINE void hessians(const StretchBatch& batch,
                               const double* x,
                               double (&h)[54][kLanes]) {
  const FaceBatch& faces = batch.faces;
  Sides sides;
  gather_sides(faces, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    Polar p = polar_of(gradient(faces, sides, l));
    double inv_t = 1.0 / p.t;
    if (Positive) project(p, inv_t);
    const double w = batch.weight[l];
    const double u[3] = {-(faces.g[0][l] + faces.g[2][l]), faces.g[0][l], faces.g[2][l]};
    const double v[3] = {-(faces.g[1][l] + faces.g[3][l]), faces.g[1][l], faces.g[3][l]};
    int k = 0;
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
#pragma GCC unroll 3
      for (int j = 0; j <= i; ++j, k += 9) {
        const double s_u = p.s11 * u[j] + p.s12 * v[j];
        const double s_v = p.s12 * u[j] + p.s22 * v[j];
        const double normal = w * (u[i] * s_u + v[i] * s_v);
        const double both = w * (u[i] * u[j] + v[i] * v[j]);
        const double turn = w * inv_t;
#pragma GCC unroll 3
        for (int b = 0; b < 3; ++b) {
          const double e_j = u[j] * p.r2[b] - v[j] * p.r1[b];
#pragma GCC unroll 3
          for (int a = 0; a < 3; ++a) {
            const double e_i = u[i] * p.r2[a] - v[i] * p.r1[a];
            h[k + a + 3 * b][l] =
                (a == b ? both : 0.0) - turn * (e_i * e_j) - normal * (p.n[a] * p.n[b]);
          }
        }
      }
    }
  }
}

void add_hessian(const StretchBatch* batches,
                 std::size_t count,
                 const double* x,
                 bool positive,
                 const std::int32_t* place,
                 double* blocks) {
  add_hessians(
      batches, count, x, positive, place, blocks,
      [](const StretchBatch& batch) -> const FaceBatch& { return batch.faces; }, hessians<false>,
      hessians<true>);
}

constexpr StretchKernels kKernels{.energy_change = energy_change,
                                  .add_gradient = add_gradient,
                                  .add_hessian = add_hessian,
                                  .woven_energy_change = woven_energy_change,
                                  .add_woven_gradient = add_woven_gradient,
                                  .add_woven_hessian = add_woven_hessian,
                                  .damping_energy_change = damping_energy_change,
                                  .add_damping_gradient = add_damping_gradient,
                                  .add_damping_hessian = add_damping_hessian,
                                  .chord_energy = chord_energy,
                                  .chord_energy_change = chord_energy_change,
                                  .add_chord_gradient = add_chord_gradient,
                                  .add_chord_hessian = add_chord_hessian};

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
