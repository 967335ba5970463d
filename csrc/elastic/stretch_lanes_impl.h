// The arithmetic of StretchKernels, written once. Loops over lanes are plain ones, which compilers turn
// into the instructions that a file is compiled for. Everything here is in an anonymous namespace,
// for the reason given in linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>

#include "elastic/degenerate.h"
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

DIFFCLOTH_INLINE void gather_sides(const StretchBatch& batch, const double* x, Sides& sides) {
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

/// The same of x1 - x0, whose differences are taken first.
DIFFCLOTH_INLINE void gather_change(const StretchBatch& batch,
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

DIFFCLOTH_INLINE void gather_motion(const StretchBatch& batch,
                                    const double* x0,
                                    const double* x1,
                                    Motion& motion) {
  gather_sides(batch, x0, motion.start);
  gather_sides(batch, x1, motion.end);
  gather_change(batch, x0, x1, motion.change);
}

DIFFCLOTH_INLINE Gradient gradient(const StretchBatch& batch, const Sides& sides, int l) {
  Gradient F;
  for (int k = 0; k < 3; ++k) {
    F.a[k] = sides.at[k][l] * batch.g[0][l] + sides.at[3 + k][l] * batch.g[2][l];
    F.b[k] = sides.at[k][l] * batch.g[1][l] + sides.at[3 + k][l] * batch.g[3][l];
  }
  return F;
}

/// |F - R|^2, in a form that needs no frame where there is hardly one.
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

double energy_change(const StretchBatch* batches,
                     std::size_t count,
                     const double* x0,
                     const double* x1) {
  double total = 0.0;
  for (const StretchBatch* batch = batches; batch != batches + count; ++batch) {
    Motion motion;
    gather_motion(*batch, x0, x1, motion);
    alignas(64) double energy[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F0 = gradient(*batch, motion.start, l);
      const Gradient F1 = gradient(*batch, motion.end, l);
      const Gradient dF = gradient(*batch, motion.change, l);
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
    }
    for (int l = 0; l < batch->size; ++l) total += energy[l];
  }
  return total;
}

/// Add forces on corners 1 and 2, and what balances them on corner 0.
DIFFCLOTH_INLINE void scatter_forces(const StretchBatch& batch,
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

DIFFCLOTH_INLINE void scatter_blocks(const StretchBatch& batch,
                                     const double (&h)[54][kLanes],
                                     const std::int32_t* place,
                                     double* blocks) {
  for (int l = 0; l < batch.size; ++l) {
    for (int k = 0; k < 6; ++k) {
      double* const block = blocks + 9 * static_cast<std::ptrdiff_t>(place[batch.slot[k][l]]);
      for (int a = 0; a < 9; ++a) block[a] += h[9 * k + a][l];
    }
  }
}

void add_gradient(const StretchBatch* batches, std::size_t count, const double* x, double* g) {
  for (const StretchBatch* batch = batches; batch != batches + count; ++batch) {
    Sides sides;
    gather_sides(*batch, x, sides);
    alignas(64) double force[6][kLanes];  // on corners 1 and 2
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(*batch, sides, l);
      const Polar p = polar_of(F);
      for (int k = 0; k < 3; ++k) {
        const double a = batch->weight[l] * (F.a[k] - p.r1[k]);
        const double b = batch->weight[l] * (F.b[k] - p.r2[k]);
        force[k][l] = a * batch->g[0][l] + b * batch->g[1][l];
        force[3 + k][l] = a * batch->g[2][l] + b * batch->g[3][l];
      }
    }
    scatter_forces(*batch, force, g);
  }
}

/// Clamp 1/t to 1/2, and the eigenvalues of S^-1 to 1.
DIFFCLOTH_INLINE void project(Polar& p, double& inv_t) {
  inv_t = smaller(inv_t, 0.5);
  const double mean = 0.5 * (p.s11 + p.s22);
  const double half = 0.5 * (p.s11 - p.s22);
  const double radius = __builtin_sqrt(half * half + p.s12 * p.s12);
  const double low = mean - radius;
  // The matrix as it is, the identity, or its larger eigenvalue alone lowered to 1; there radius > 0.
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
  Sides sides;
  gather_sides(batch, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    Polar p = polar_of(gradient(batch, sides, l));
    double inv_t = 1.0 / p.t;
    if (Positive) project(p, inv_t);
    const double w = batch.weight[l];
    const double u[3] = {-(batch.g[0][l] + batch.g[2][l]), batch.g[0][l], batch.g[2][l]};
    const double v[3] = {-(batch.g[1][l] + batch.g[3][l]), batch.g[1][l], batch.g[3][l]};
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
  alignas(64) double h[54][kLanes];
  for (const StretchBatch* batch = batches; batch != batches + count; ++batch) {
    if (positive) {
      hessians<true>(*batch, x, h);
    } else {
      hessians<false>(*batch, x, h);
    }
    scatter_blocks(*batch, h, place, blocks);
  }
}

/// C - C_n, of which 12 and 21 are one number.
struct Strain {
  double e11, e12, e22;
};

DIFFCLOTH_INLINE Gradient start_of(const DampingBatch& batch, int l) {
  Gradient F;
  for (int k = 0; k < 3; ++k) {
    F.a[k] = batch.start[k][l];
    F.b[k] = batch.start[3 + k][l];
  }
  return F;
}

/// A^T B + C^T A: the change of F^T F with A that of F, from C to B.
DIFFCLOTH_INLINE Strain strain_change(const Gradient& A, const Gradient& B, const Gradient& C) {
  return {.e11 = dot(A.a, B.a) + dot(C.a, A.a),
          .e12 = dot(A.a, B.b) + dot(C.a, A.b),
          .e22 = dot(A.b, B.b) + dot(C.b, A.b)};
}

DIFFCLOTH_INLINE Strain strain_of(const DampingBatch& batch, const Gradient& F, int l) {
  const Gradient F_n = start_of(batch, l);
  Gradient dF;
  for (int k = 0; k < 3; ++k) {
    dF.a[k] = F.a[k] - F_n.a[k];
    dF.b[k] = F.b[k] - F_n.b[k];
  }
  return strain_change(dF, F, F_n);
}

double damping_energy_change(const DampingBatch* batches,
                             std::size_t count,
                             const double* x0,
                             const double* x1) {
  double total = 0.0;
  for (const DampingBatch* batch = batches; batch != batches + count; ++batch) {
    Motion motion;
    gather_motion(batch->faces, x0, x1, motion);
    alignas(64) double energy[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F0 = gradient(batch->faces, motion.start, l);
      const Gradient F1 = gradient(batch->faces, motion.end, l);
      const Strain dC = strain_change(gradient(batch->faces, motion.change, l), F1, F0);
      const Strain e0 = strain_of(*batch, F0, l);
      const Strain e1 = strain_of(*batch, F1, l);
      energy[l] = (0.125 * batch->faces.weight[l]) *
                  ((e0.e11 + e1.e11) * dC.e11 + 2.0 * ((e0.e12 + e1.e12) * dC.e12) +
                   (e0.e22 + e1.e22) * dC.e22);
    }
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

void add_damping_gradient(const DampingBatch* batches,
                          std::size_t count,
                          const double* x,
                          double* g) {
  for (const DampingBatch* batch = batches; batch != batches + count; ++batch) {
    const StretchBatch& faces = batch->faces;
    Sides sides;
    gather_sides(faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(faces, sides, l);
      const Strain e = strain_of(*batch, F, l);
      const double half = 0.5 * faces.weight[l];
      for (int k = 0; k < 3; ++k) {
        const double a = half * (F.a[k] * e.e11 + F.b[k] * e.e12);
        const double b = half * (F.a[k] * e.e12 + F.b[k] * e.e22);
        force[k][l] = a * faces.g[0][l] + b * faces.g[1][l];
        force[3 + k][l] = a * faces.g[2][l] + b * faces.g[3][l];
      }
    }
    scatter_forces(faces, force, g);
  }
}

/// The positive semi-definite part.
DIFFCLOTH_INLINE Strain positive_part(const Strain& e) {
  const double mean = 0.5 * (e.e11 + e.e22);
  const double half = 0.5 * (e.e11 - e.e22);
  const double radius = __builtin_sqrt(half * half + e.e12 * e.e12);
  const bool all = mean - radius >= 0.0;
  const bool none = mean + radius <= 0.0;
  // Where it is a part the radius is positive.
  const double larger_one = 0.5 * (mean + radius);
  const double scale = larger_one / radius;
  const double p11 = larger_one + scale * half;
  const double p12 = scale * e.e12;
  const double p22 = larger_one - scale * half;
  return {.e11 = all ? e.e11 : (none ? 0.0 : p11),
          .e12 = all ? e.e12 : (none ? 0.0 : p12),
          .e22 = all ? e.e22 : (none ? 0.0 : p22)};
}

void add_damping_hessian(const DampingBatch* batches,
                         std::size_t count,
                         const double* x,
                         bool positive,
                         const std::int32_t* place,
                         double* blocks) {
  alignas(64) double h[54][kLanes];
  for (const DampingBatch* batch = batches; batch != batches + count; ++batch) {
    const StretchBatch& faces = batch->faces;
    Sides sides;
    gather_sides(faces, x, sides);
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(faces, sides, l);
      const Strain exact = strain_of(*batch, F, l);
      const Strain projected = positive_part(exact);
      const Strain e = {.e11 = positive ? projected.e11 : exact.e11,
                        .e12 = positive ? projected.e12 : exact.e12,
                        .e22 = positive ? projected.e22 : exact.e22};
      const double half = 0.5 * faces.weight[l];
      const double u[3] = {-(faces.g[0][l] + faces.g[2][l]), faces.g[0][l], faces.g[2][l]};
      const double v[3] = {-(faces.g[1][l] + faces.g[3][l]), faces.g[1][l], faces.g[3][l]};
      int k = 0;
#pragma GCC unroll 3
      for (int p = 0; p < 3; ++p) {
#pragma GCC unroll 3
        for (int q = 0; q <= p; ++q, k += 9) {
          const double both = half * (u[p] * u[q] + v[p] * v[q]);
          const double diagonal =
              half * (u[p] * (e.e11 * u[q] + e.e12 * v[q]) + v[p] * (e.e12 * u[q] + e.e22 * v[q]));
#pragma GCC unroll 3
          for (int b = 0; b < 3; ++b) {
            const double of_p = half * (F.a[b] * u[p] + F.b[b] * v[p]);
#pragma GCC unroll 3
            for (int a = 0; a < 3; ++a) {
              const double of_q = F.a[a] * u[q] + F.b[a] * v[q];
              h[k + a + 3 * b][l] = of_q * of_p + both * (F.a[a] * F.a[b] + F.b[a] * F.b[b]) +
                                    (a == b ? diagonal : 0.0);
            }
          }
        }
      }
    }
    scatter_blocks(faces, h, place, blocks);
  }
}

constexpr StretchKernels kKernels{.energy_change = energy_change,
                                  .add_gradient = add_gradient,
                                  .add_hessian = add_hessian,
                                  .damping_energy_change = damping_energy_change,
                                  .add_damping_gradient = add_damping_gradient,
                                  .add_damping_hessian = add_damping_hessian};

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
