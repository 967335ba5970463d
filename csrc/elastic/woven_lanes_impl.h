// The arithmetic of the stretch of woven triangles of StretchKernels: see stretch_lanes_impl.h. Notation
// and derivation are those of orthotropic_stretch.h.

#pragma once

#include <cstddef>
#include <cstdint>

#include "elastic/degenerate.h"
#include "elastic/face_lanes_impl.h"
#include "elastic/weave_lanes_impl.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

/// e = S - I, whose area ratio is not floored.
DIFFCLOTH_INLINE Symmetric strain_of(const Polar& p) {
  const double inv_t = 1.0 / p.t;
  return {
      .uu = (p.c11 + p.d) * inv_t - 1.0, .uv = p.c12 * inv_t, .vv = (p.c22 + p.d) * inv_t - 1.0};
}

double woven_energy_change(const WovenBatch* batches,
                           std::size_t count,
                           const double* x0,
                           const double* x1) {
  double total = 0.0;
  for (const WovenBatch* batch = batches; batch != batches + count; ++batch) {
    Motion motion;
    gather_motion(batch->faces, x0, x1, motion);
    alignas(64) double energy[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F0 = gradient(batch->faces, motion.start, l);
      const Gradient F1 = gradient(batch->faces, motion.end, l);
      const Stiffness K = stiffness_of(*batch, l);
      const Polar p0 = polar_of(F0);
      const Polar p1 = polar_of(F1);
      const Symmetric e0 = strain_of(p0);
      const Symmetric e1 = strain_of(p1);
      // M dS + dS M = 2 Y  has the solution  dS = (Y + adj(M) Y adj(M) / det M) / tr M.
      const Symmetric Y = change_of_square(gradient(batch->faces, motion.change, l), F1, F0);
      const Symmetric twice_mean = sum(e0, e1);
      const double m_uu = twice_mean.uu + 2.0;
      const double m_uv = twice_mean.uv;
      const double m_vv = twice_mean.vv + 2.0;
      const double a_u = m_vv * Y.uu - m_uv * Y.uv;  // adj(M) Y
      const double a_v = m_vv * Y.uv - m_uv * Y.vv;
      const double b_u = m_uu * Y.uv - m_uv * Y.uu;
      const double b_v = m_uu * Y.vv - m_uv * Y.uv;
      const double inv_det = 1.0 / (m_uu * m_vv - m_uv * m_uv);
      const double scale = 1.0 / (m_uu + m_vv);
      const Symmetric dS = {.uu = scale * (Y.uu + inv_det * (a_u * m_vv - a_v * m_uv)),
                            .uv = scale * (Y.uv + inv_det * (a_v * m_uu - a_u * m_uv)),
                            .vv = scale * (Y.vv + inv_det * (b_v * m_uu - b_u * m_uv))};
      const double regular = product(times(K, twice_mean), dS);
      const double difference = product(times(K, e1), e1) - product(times(K, e0), e0);
      const bool is_regular = smaller(p0.d, p1.d) >= kNearlyDegenerate;
      energy[l] = 0.5 * (is_regular ? regular : difference);
    }
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

/// A triangle at one F. B = R^T dE/dF, and r = omega / t is what makes it not symmetric.
struct WovenState {
  Symmetric e, T;
  double r;
  double b11, b12, b21, b22;
};

DIFFCLOTH_INLINE WovenState state_of(const Stiffness& K, const Polar& p) {
  WovenState s;
  s.e = strain_of(p);
  s.T = times(K, s.e);
  s.r = (s.e.uv * (s.T.uu - s.T.vv) - s.T.uv * (s.e.uu - s.e.vv)) / p.t;
  s.b11 = s.T.uu;
  s.b12 = s.T.uv - s.r;
  s.b21 = s.T.uv + s.r;
  s.b22 = s.T.vv;
  return s;
}

void add_woven_gradient(const WovenBatch* batches, std::size_t count, const double* x, double* g) {
  for (const WovenBatch* batch = batches; batch != batches + count; ++batch) {
    const FaceBatch& faces = batch->faces;
    Sides sides;
    gather_sides(faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Polar p = polar_of(gradient(faces, sides, l));
      const WovenState s = state_of(stiffness_of(*batch, l), p);
      for (int k = 0; k < 3; ++k) {
        const double a = p.r1[k] * s.b11 + p.r2[k] * s.b21;
        const double b = p.r1[k] * s.b12 + p.r2[k] * s.b22;
        force[k][l] = a * faces.g[0][l] + b * faces.g[1][l];
        force[3 + k][l] = a * faces.g[2][l] + b * faces.g[3][l];
      }
    }
    scatter_forces(faces, force, g);
  }
}

// The in-plane part of the Hessian is a form of changes along R of F's columns. Beside warp, weft and shear, which
// change S alone, stands the rotation J^T / sqrt(2): there the form is an arrow,
//
//   diag(k_w, k_f, k_wf), bordered by z = (z_w, z_f, z_s) and h.
//
// Its last column is the change of R^T dE/dF with the rotation. The frame turns at the rate w = -sqrt(2) / t, and
// with b = w S_uv and a = -w (S_uu - S_vv) / 2
//
//   dS = [[b, a], [a, -b]],   d omega = a (T_uu - T_vv) - 2 b T_uv + b (k_w + k_f) S_uv - a k_wf (S_uu - S_vv),
//   d(dE/dF) = R (w J B + K o dS + (d omega / t) J).
struct Arrow {
  double z[3];
  double h;
};

DIFFCLOTH_INLINE Arrow arrow_of(const Stiffness& K, const Polar& p, const WovenState& s) {
  const double inv_t = 1.0 / p.t;
  const double w = -__builtin_sqrt(2.0) * inv_t;
  const double difference = s.e.uu - s.e.vv;
  const double b = w * s.e.uv;
  const double a = -0.5 * w * difference;
  const double d_omega = a * (s.T.uu - s.T.vv) - 2.0 * (b * s.T.uv) +
                         b * (K.warp + K.weft) * s.e.uv - a * K.shear * difference;
  const double both = K.shear * a;
  const double ratio = d_omega * inv_t;
  const double c12 = both - w * s.b22 - ratio;
  const double c21 = both + w * s.b11 + ratio;
  const double half = __builtin_sqrt(0.5);
  return {.z = {K.warp * b - w * s.b21, w * s.b12 - K.weft * b, half * (c12 + c21)},
          .h = half * (c12 - c21)};
}

/// What arrows are to be relieved of: value v v^T with v = (vector, 1), where value <= 0.
struct NegativeParts {
  alignas(64) double value[kLanes];
  alignas(64) double vector[3][kLanes];
};

/// The frame of each triangle, the arrow of its form and its second stress.
struct WovenForms {
  alignas(64) double r1[3][kLanes];
  alignas(64) double r2[3][kLanes];
  alignas(64) double n[3][kLanes];
  alignas(64) double k[3][kLanes];  ///< k_w, k_f, k_wf
  alignas(64) double z[3][kLanes];
  alignas(64) double h[kLanes];
  alignas(64) double second[3][kLanes];  ///< uu, uv, vv
};

template <bool Positive>
DIFFCLOTH_INLINE void forms_of(const WovenBatch& batch, const double* x, WovenForms& forms) {
  Sides sides;
  gather_sides(batch.faces, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    const Polar p = polar_of(gradient(batch.faces, sides, l));
    const Stiffness K = stiffness_of(batch, l);
    const WovenState s = state_of(K, p);
    const Arrow arrow = arrow_of(K, p, s);
    // The second stress is the symmetric part of S^-1 B.
    const Symmetric exact = {
        .uu = p.s11 * s.b11 + p.s12 * s.b21,
        .uv = 0.5 * ((p.s11 * s.b12 + p.s12 * s.b22) + (p.s12 * s.b11 + p.s22 * s.b21)),
        .vv = p.s12 * s.b12 + p.s22 * s.b22};
    const Symmetric second = Positive ? positive_part(exact) : exact;
    for (int k = 0; k < 3; ++k) {
      forms.r1[k][l] = p.r1[k];
      forms.r2[k][l] = p.r2[k];
      forms.n[k][l] = p.n[k];
      forms.z[k][l] = arrow.z[k];
    }
    forms.h[l] = arrow.h;
    forms.k[0][l] = K.warp;
    forms.k[1][l] = K.weft;
    forms.k[2][l] = K.shear;
    forms.second[0][l] = second.uu;
    forms.second[1][l] = second.uv;
    forms.second[2][l] = second.vv;
  }
}

/// Relative step below which the next one of Newton's method is below rounding.
constexpr double kSmallStep = 1e-8;
constexpr int kMostSteps = 200;  // each at least doubles y until the largest k_j has no part

/// The negative eigenvalue of each arrow and its vector, where there is one: only one, as K is positive. It is the
/// root of
///
///   f(y) = h - y - sum_j z_j^2 / (k_j - y),
///
/// which falls and is concave up to the least k_j. Newton's method goes down to the root from the eigenvalue with the
/// largest k_j for all; where f(0) >= 0, y stays zero.
DIFFCLOTH_INLINE void negative_parts(const WovenForms& forms, NegativeParts& parts) {
  alignas(64) double y[kLanes];
  for (int l = 0; l < kLanes; ++l) {
    const double most = larger(larger(forms.k[0][l], forms.k[1][l]), forms.k[2][l]);
    const double z_sq = forms.z[0][l] * forms.z[0][l] + forms.z[1][l] * forms.z[1][l] +
                        forms.z[2][l] * forms.z[2][l];
    const double mean = 0.5 * (forms.h[l] + most);
    const double away = 0.5 * (forms.h[l] - most);
    y[l] = smaller(mean - __builtin_sqrt(away * away + z_sq), 0.0);
  }
  for (int i = 0; i < kMostSteps; ++i) {
    alignas(64) double left[kLanes];  // of the step, beside what is small
    for (int l = 0; l < kLanes; ++l) {
      double f = forms.h[l] - y[l];
      double slope = -1.0;
#pragma GCC unroll 3
      for (int j = 0; j < 3; ++j) {
        const double v = forms.z[j][l] / (forms.k[j][l] - y[l]);
        f -= forms.z[j][l] * v;
        slope -= v * v;
      }
      const double next = smaller(y[l] - f / slope, 0.0);
      left[l] = (y[l] - next) + kSmallStep * next;
      y[l] = next;
    }
    bool is_done = true;
    for (const double step : left) is_done = is_done && !(step > 0.0);
    if (is_done) break;
  }
  for (int l = 0; l < kLanes; ++l) {
    double norm_sq = 1.0;
#pragma GCC unroll 3
    for (int j = 0; j < 3; ++j) {
      const double v = forms.z[j][l] / (y[l] - forms.k[j][l]);
      parts.vector[j][l] = v;
      norm_sq += v * v;
    }
    parts.value[l] = y[l] / norm_sq;
  }
}

/// What of the arrow meets the two changes of F that a corner makes along r1 and r2.
struct CornerChange {
  double turn[2];  ///< along the rotation
  double bent[2];  ///< along z, and half of h along the rotation
  double cut[2];   ///< along the vector of the negative part
};

DIFFCLOTH_INLINE CornerChange
corner_change(double u, double v, const WovenForms& forms, const NegativeParts& parts, int l) {
  const double half = __builtin_sqrt(0.5);
  CornerChange c;
  c.turn[0] = half * v;
  c.turn[1] = -(half * u);
  c.bent[0] = forms.z[0][l] * u + forms.z[2][l] * (half * v) + (0.5 * forms.h[l]) * c.turn[0];
  c.bent[1] = forms.z[1][l] * v + forms.z[2][l] * (half * u) + (0.5 * forms.h[l]) * c.turn[1];
  c.cut[0] = parts.vector[0][l] * u + (parts.vector[2][l] + 1.0) * (half * v);
  c.cut[1] = parts.vector[1][l] * v + (parts.vector[2][l] - 1.0) * (half * u);
  return c;
}

template <bool Positive>
DIFFCLOTH_INLINE void woven_hessians(const WovenBatch& batch,
                                     const double* x,
                                     double (&blocks)[54][kLanes]) {
  WovenForms forms;
  NegativeParts parts = {};
  forms_of<Positive>(batch, x, forms);
  if (Positive) negative_parts(forms, parts);
  const FaceBatch& faces = batch.faces;
  for (int l = 0; l < kLanes; ++l) {
    const double u[3] = {-(faces.g[0][l] + faces.g[2][l]), faces.g[0][l], faces.g[2][l]};
    const double v[3] = {-(faces.g[1][l] + faces.g[3][l]), faces.g[1][l], faces.g[3][l]};
    CornerChange c[3];
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) c[i] = corner_change(u[i], v[i], forms, parts, l);
    const double warp = forms.k[0][l];
    const double weft = forms.k[1][l];
    const double shear = 0.5 * forms.k[2][l];
    int k = 0;
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
#pragma GCC unroll 3
      for (int j = 0; j <= i; ++j, k += 9) {
        double m[2][2] = {{warp * (u[i] * u[j]) + shear * (v[i] * v[j]), shear * (v[i] * u[j])},
                          {shear * (u[i] * v[j]), weft * (v[i] * v[j]) + shear * (u[i] * u[j])}};
#pragma GCC unroll 2
        for (int a = 0; a < 2; ++a) {
#pragma GCC unroll 2
          for (int b = 0; b < 2; ++b) {
            m[a][b] += c[i].bent[a] * c[j].turn[b] + c[i].turn[a] * c[j].bent[b] -
                       parts.value[l] * (c[i].cut[a] * c[j].cut[b]);
          }
        }
        const double normal = u[i] * (forms.second[0][l] * u[j] + forms.second[1][l] * v[j]) +
                              v[i] * (forms.second[1][l] * u[j] + forms.second[2][l] * v[j]);
#pragma GCC unroll 3
        for (int b = 0; b < 3; ++b) {
          const double of_r1 = m[0][0] * forms.r1[b][l] + m[0][1] * forms.r2[b][l];
          const double of_r2 = m[1][0] * forms.r1[b][l] + m[1][1] * forms.r2[b][l];
#pragma GCC unroll 3
          for (int a = 0; a < 3; ++a) {
            blocks[k + a + 3 * b][l] = forms.r1[a][l] * of_r1 + forms.r2[a][l] * of_r2 +
                                       normal * (forms.n[a][l] * forms.n[b][l]);
          }
        }
      }
    }
  }
}

void add_woven_hessian(const WovenBatch* batches,
                       std::size_t count,
                       const double* x,
                       bool positive,
                       const std::int32_t* place,
                       double* blocks) {
  add_hessians(
      batches, count, x, positive, place, blocks,
      [](const WovenBatch& batch) -> const FaceBatch& { return batch.faces; },
      woven_hessians<false>, woven_hessians<true>);
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
