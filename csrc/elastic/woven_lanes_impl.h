// The arithmetic of the stretch of woven triangles for StretchKernels: see stretch_lanes_impl.h.
// Notation and derivation are in orthotropic_stretch.h.

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

DIFFCLOTH_INLINE void cross(const double* a, const double* b, double* result) {
  result[0] = a[1] * b[2] - a[2] * b[1];
  result[1] = a[2] * b[0] - a[0] * b[2];
  result[2] = a[0] * b[1] - a[1] * b[0];
}

/// Lengths of the yarns, the normal w x f, its length and tr S.
struct Lengths {
  double warp, weft;
  double normal[3];
  double d, t;
};

DIFFCLOTH_INLINE Lengths lengths_of(const Gradient& F) {
  Lengths q;
  const double c11 = dot(F.a, F.a);
  const double c22 = dot(F.b, F.b);
  cross(F.a, F.b, q.normal);
  q.warp = __builtin_sqrt(c11);
  q.weft = __builtin_sqrt(c22);
  q.d = __builtin_sqrt(dot(q.normal, q.normal));
  q.t = __builtin_sqrt(c11 + c22 + 2.0 * q.d);
  return q;
}

/// b - a from the change b^2 - a^2 of the squares.
DIFFCLOTH_INLINE double change_of_root(double of_squares, double a, double b) {
  return of_squares / larger(a + b, kShortest);
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
      const Gradient dF = gradient(batch->faces, motion.change, l);
      const Stiffness K = stiffness_of(*batch, l);
      const Lengths q0 = lengths_of(F0);
      const Lengths q1 = lengths_of(F1);
      Gradient twice;  // the mean of F0 and F1
      for (int k = 0; k < 3; ++k) {
        twice.a[k] = F0.a[k] + F1.a[k];
        twice.b[k] = F0.b[k] + F1.b[k];
      }
      double turned[3];
      double sheared[3];
      cross(dF.a, twice.b, turned);
      cross(twice.a, dF.b, sheared);
      double twice_d_sq = 0.0;
      for (int k = 0; k < 3; ++k) {
        twice_d_sq += (turned[k] + sheared[k]) * (q0.normal[k] + q1.normal[k]);
      }
      const double c11 = dot(dF.a, twice.a);
      const double c22 = dot(dF.b, twice.b);
      const double warp = change_of_root(c11, q0.warp, q1.warp);
      const double weft = change_of_root(c22, q0.weft, q1.weft);
      const double twice_d = change_of_root(twice_d_sq, q0.d, q1.d);
      const double t = change_of_root(c11 + c22 + twice_d, q0.t, q1.t);
      const double of_warp = 0.5 * (K.warp * ((q0.warp - 1.0) + (q1.warp - 1.0)));
      const double of_weft = 0.5 * (K.weft * ((q0.weft - 1.0) + (q1.weft - 1.0)));
      energy[l] = of_warp * warp + of_weft * weft + K.shear * ((warp + weft) - t);
    }
    for (int l = 0; l < batch->faces.size; ++l) total += energy[l];
  }
  return total;
}

void add_woven_gradient(const WovenBatch* batches, std::size_t count, const double* x, double* g) {
  for (const WovenBatch* batch = batches; batch != batches + count; ++batch) {
    const FaceBatch& faces = batch->faces;
    Sides sides;
    gather_sides(faces, x, sides);
    alignas(64) double force[6][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const Gradient F = gradient(faces, sides, l);
      const Polar p = polar_of(F);
      const Stiffness K = stiffness_of(*batch, l);
      const double warp = __builtin_sqrt(p.c11);
      const double weft = __builtin_sqrt(p.c22);
      const double of_warp = (K.warp - K.shear) * ((warp - 1.0) / larger(warp, kShortest));
      const double of_weft = (K.weft - K.shear) * ((weft - 1.0) / larger(weft, kShortest));
      for (int k = 0; k < 3; ++k) {
        const double a = K.shear * (F.a[k] - p.r1[k]) + of_warp * F.a[k];
        const double b = K.shear * (F.b[k] - p.r2[k]) + of_weft * F.b[k];
        put_forces(faces, k, a, b, l, force);
      }
    }
    scatter_forces(faces, force, g);
  }
}

// In the frame of R, w = (w_1, w_2) |w| and f = (f_1, f_2) |f| with unit vectors. An in-plane change of
// F moves each yarn along itself, with the stiffness k_y, and across itself, with
//
//   m_y = k_wf + (k_y - k_wf) (1 - 1 / |y|),
//
// minus the part that turns the frame: the form is
//
//   diag(k_w, m_w, k_f, m_f) - rho e e^T,   e = (w_2, w_1, -f_1, f_2),   rho = k_wf / t,   |e|^2 = 2.
//
// If the Hessian is positive, all m_y are. The projection raises negative m_y to zero and removes the
// remaining negative eigenvalue, if any. So it is exact if no m_y is negative, and no smaller than the
// Hessian anywhere.

/// The frame of each triangle, its form in plane and its second stress.
struct WovenForms {
  alignas(64) double r1[3][kLanes];
  alignas(64) double r2[3][kLanes];
  alignas(64) double n[3][kLanes];
  alignas(64) double w[2][kLanes];
  alignas(64) double f[2][kLanes];
  alignas(64) double diagonal[4][kLanes];  ///< k_w, m_w, k_f, m_f
  alignas(64) double rho[kLanes];
  alignas(64) double second[3][kLanes];  ///< uu, uv, vv
};

template <bool Positive>
DIFFCLOTH_INLINE void forms_of(const WovenBatch& batch, const double* x, WovenForms& forms) {
  Sides sides;
  gather_sides(batch.faces, x, sides);
  for (int l = 0; l < kLanes; ++l) {
    const Polar p = polar_of(gradient(batch.faces, sides, l));
    const Stiffness K = stiffness_of(batch, l);
    // S t has the directions of the yarns in its columns. A yarn without direction lies along its own
    // axis.
    const double w1 = larger(p.c11 + p.d, kShortest);
    const double f2 = larger(p.c22 + p.d, kShortest);
    const double inv_w = 1.0 / __builtin_sqrt(w1 * w1 + p.c12 * p.c12);
    const double inv_f = 1.0 / __builtin_sqrt(f2 * f2 + p.c12 * p.c12);
    const double warp = larger(__builtin_sqrt(p.c11), kDegenerate);
    const double weft = larger(__builtin_sqrt(p.c22), kDegenerate);
    const double of_warp = (K.warp - K.shear) * (1.0 - 1.0 / warp);
    const double of_weft = (K.weft - K.shear) * (1.0 - 1.0 / weft);
    const Symmetric exact = {.uu = K.shear * (1.0 - p.s11) + of_warp,
                             .uv = -(K.shear * p.s12),
                             .vv = K.shear * (1.0 - p.s22) + of_weft};
    const Symmetric second = Positive ? positive_part(exact) : exact;
    for (int k = 0; k < 3; ++k) {
      forms.r1[k][l] = p.r1[k];
      forms.r2[k][l] = p.r2[k];
      forms.n[k][l] = p.n[k];
    }
    forms.w[0][l] = w1 * inv_w;
    forms.w[1][l] = p.c12 * inv_w;
    forms.f[0][l] = p.c12 * inv_f;
    forms.f[1][l] = f2 * inv_f;
    const double across_warp = K.shear + of_warp;
    const double across_weft = K.shear + of_weft;
    forms.diagonal[0][l] = K.warp;
    forms.diagonal[1][l] = Positive ? larger(across_warp, 0.0) : across_warp;
    forms.diagonal[2][l] = K.weft;
    forms.diagonal[3][l] = Positive ? larger(across_weft, 0.0) : across_weft;
    forms.rho[l] = K.shear / p.t;
    forms.second[0][l] = second.uu;
    forms.second[1][l] = second.uv;
    forms.second[2][l] = second.vv;
  }
}

/// Rank-one term value v v^T that raises the negative eigenvalue of a form to zero; v by columns of F along
/// r1 and r2.
struct NegativeParts {
  alignas(64) double value[kLanes];
  alignas(64) double warp[2][kLanes];
  alignas(64) double weft[2][kLanes];
};

/// Relative step below which the next one of Newton's method is below rounding.
constexpr double kSmallStep = 1e-8;
/// Share of rho that counts as zero.
constexpr double kNoPart = 1e-16;
constexpr int kMostSteps = 100;

/// The negative eigenvalue -s of each form is the root of
///
///   h(s) = 1 / sum_j e_j^2 / (d_j + s) = rho,
///
/// which is increasing and concave, so that Newton's method converges monotonically from a lower bound:
/// h is no larger than half the weighted mean of d_j + s. If h(0) >= rho, there is none, and s stays at
/// the value that counts as zero.
DIFFCLOTH_INLINE void negative_parts(const WovenForms& forms, NegativeParts& parts) {
  alignas(64) double e_sq[4][kLanes];
  alignas(64) double s[kLanes];
  for (int l = 0; l < kLanes; ++l) {
    e_sq[0][l] = forms.w[1][l] * forms.w[1][l];
    e_sq[1][l] = forms.w[0][l] * forms.w[0][l];
    e_sq[2][l] = forms.f[0][l] * forms.f[0][l];
    e_sq[3][l] = forms.f[1][l] * forms.f[1][l];
    double mean = 0.0;
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) mean += 0.5 * (e_sq[j][l] * forms.diagonal[j][l]);
    s[l] = larger(2.0 * forms.rho[l] - mean, kNoPart * forms.rho[l]);
  }
  for (int i = 0; i < kMostSteps; ++i) {
    alignas(64) double left[kLanes];  // step minus the smallest significant step
    for (int l = 0; l < kLanes; ++l) {
      double sum = 0.0;
      double slope = 0.0;
#pragma GCC unroll 4
      for (int j = 0; j < 4; ++j) {
        const double inverse = 1.0 / (forms.diagonal[j][l] + s[l]);
        const double v = e_sq[j][l] * inverse;
        sum += v;
        slope += v * inverse;
      }
      const double next = s[l] + sum * (forms.rho[l] * sum - 1.0) / slope;
      const double least = larger(next, kNoPart * forms.rho[l]);
      left[l] = (least - s[l]) - kSmallStep * least;
      s[l] = least;
    }
    bool is_done = true;
    for (const double step : left) is_done = is_done && !(step > 0.0);
    if (is_done) break;
  }
  for (int l = 0; l < kLanes; ++l) {
    double v[4];
    double norm_sq = 0.0;
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
      v[j] = 1.0 / (forms.diagonal[j][l] + s[l]);
      norm_sq += e_sq[j][l] * v[j] * v[j];
    }
    parts.value[l] = s[l] / norm_sq;
    parts.warp[0][l] = (v[0] - v[1]) * (forms.w[0][l] * forms.w[1][l]);
    parts.warp[1][l] = e_sq[0][l] * v[0] + e_sq[1][l] * v[1];
    parts.weft[0][l] = -(e_sq[2][l] * v[2] + e_sq[3][l] * v[3]);
    parts.weft[1][l] = (v[3] - v[2]) * (forms.f[0][l] * forms.f[1][l]);
  }
}

/// The form of changes of one yarn in plane: m I + (k - m) y y^T.
DIFFCLOTH_INLINE Symmetric form_of_yarn(double along, double across, double y1, double y2) {
  const double excess = along - across;
  return {.uu = across + excess * (y1 * y1),
          .uv = excess * (y1 * y2),
          .vv = across + excess * (y2 * y2)};
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
    const Symmetric warp =
        form_of_yarn(forms.diagonal[0][l], forms.diagonal[1][l], forms.w[0][l], forms.w[1][l]);
    const Symmetric weft =
        form_of_yarn(forms.diagonal[2][l], forms.diagonal[3][l], forms.f[0][l], forms.f[1][l]);
    const double rho = forms.rho[l];
    double raised[3][2];
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
#pragma GCC unroll 2
      for (int a = 0; a < 2; ++a) raised[i][a] = parts.warp[a][l] * u[i] + parts.weft[a][l] * v[i];
    }
    int k = 0;
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
#pragma GCC unroll 3
      for (int j = 0; j <= i; ++j, k += 9) {
        const double uu = u[i] * u[j];
        const double vv = v[i] * v[j];
        const double uv = warp.uv * uu + weft.uv * vv;
        double m[2][2] = {{warp.uu * uu + (weft.uu - rho) * vv, uv + rho * (v[i] * u[j])},
                          {uv + rho * (u[i] * v[j]), (warp.vv - rho) * uu + weft.vv * vv}};
        if (Positive) {
#pragma GCC unroll 2
          for (int a = 0; a < 2; ++a) {
            const double scaled = parts.value[l] * raised[i][a];
#pragma GCC unroll 2
            for (int b = 0; b < 2; ++b) m[a][b] += scaled * raised[j][b];
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
