// The arithmetic of DirectionKernels, written once over vectors of `kPack` doubles, a divisor of
// kDirectionLanes. Everything here is in an anonymous namespace, for the reason given in
// linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>

#include "contact/direction_kernels.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::contact {

namespace {

using Pack = double __attribute__((vector_size(8 * kPack)));
using Stored = double __attribute__((vector_size(8 * kPack), aligned(8), may_alias));

DIFFCLOTH_INLINE void load(const double* from, double& to) { to = *from; }
DIFFCLOTH_INLINE void load(const double* from, Pack& to) {
  to = *reinterpret_cast<const Stored*>(from);
}
DIFFCLOTH_INLINE void store(double* to, double from) { *to = from; }
DIFFCLOTH_INLINE void store(double* to, const Pack& from) { *reinterpret_cast<Stored*>(to) = from; }

/// Arithmetic of one direction, or of one Pack of directions, in rows of kStride directions side by
/// side.
template <class Number, int kStride>
struct Directions {
  struct Vector {
    Number at[3];
  };

  static DIFFCLOTH_INLINE Vector zero() { return {{Number{}, Number{}, Number{}}}; }

  static DIFFCLOTH_INLINE Vector row(const double* rows, std::ptrdiff_t point) {
    Vector result;
    for (int k = 0; k < 3; ++k) load(rows + kStride * (3 * point + k), result.at[k]);
    return result;
  }

  static DIFFCLOTH_INLINE void add(const Vector& v, std::ptrdiff_t point, double* rows) {
    Vector sum = row(rows, point);
    for (int k = 0; k < 3; ++k) store(rows + kStride * (3 * point + k), sum.at[k] + v.at[k]);
  }

  static DIFFCLOTH_INLINE Vector sum(const Vector& a, const Vector& b) {
    return {{a.at[0] + b.at[0], a.at[1] + b.at[1], a.at[2] + b.at[2]}};
  }
  static DIFFCLOTH_INLINE Vector minus(const Vector& a, const Vector& b) {
    return {{a.at[0] - b.at[0], a.at[1] - b.at[1], a.at[2] - b.at[2]}};
  }
  static DIFFCLOTH_INLINE Vector scaled(double s, const Vector& a) {
    return {{s * a.at[0], s * a.at[1], s * a.at[2]}};
  }
  /// Shared vector times one number per direction.
  static DIFFCLOTH_INLINE Vector along(const double* v, const Number& s) {
    return {{v[0] * s, v[1] * s, v[2] * s}};
  }
  static DIFFCLOTH_INLINE Number dot(const double* a, const Vector& b) {
    return a[0] * b.at[0] + a[1] * b.at[1] + a[2] * b.at[2];
  }
  /// a x b and b x a, for a vector `a` shared by all directions.
  static DIFFCLOTH_INLINE Vector cross(const double* a, const Vector& b) {
    return {{a[1] * b.at[2] - a[2] * b.at[1], a[2] * b.at[0] - a[0] * b.at[2],
             a[0] * b.at[1] - a[1] * b.at[0]}};
  }
  static DIFFCLOTH_INLINE Vector cross(const Vector& b, const double* a) {
    return {{b.at[1] * a[2] - b.at[2] * a[1], b.at[2] * a[0] - b.at[0] * a[2],
             b.at[0] * a[1] - b.at[1] * a[0]}};
  }
  static DIFFCLOTH_INLINE Vector tangential(const Vector& v, const double* n) {
    return minus(v, along(n, dot(n, v)));
  }
  static DIFFCLOTH_INLINE Vector edge(const double* rows,
                                      const std::int32_t* point,
                                      const int* ends) {
    return minus(row(rows, point[ends[1]]), row(rows, point[ends[0]]));
  }
  static DIFFCLOTH_INLINE void add_edge(const Vector& v,
                                        const std::int32_t* point,
                                        const int* ends,
                                        double* rows) {
    add(v, point[ends[1]], rows);
    add(scaled(-1.0, v), point[ends[0]], rows);
  }

  static void contact_product(const ContactProduct& of, const double* z, double* y) {
    Vector from[4];
    Vector to[4];
    for (int p = 0; p < 4; ++p) {
      from[p] = row(z, of.point[p]);
      to[p] = zero();
    }
    if (of.along != 0.0) {
      Vector total = zero();
      for (int p = 0; p < 4; ++p) total = sum(total, scaled(of.c[p], from[p]));
      for (int p = 0; p < 4; ++p) to[p] = scaled(of.along * of.c[p], total);
    }
    for (int k = 0; k < of.count; ++k) {
      Number share = dot(of.right[k], from[0]);
      for (int p = 1; p < 4; ++p) share += dot(of.right[k] + 3 * p, from[p]);
      for (int p = 0; p < 4; ++p) to[p] = sum(to[p], along(of.left[k] + 3 * p, share));
    }
    if (of.rest != nullptr) {
      for (int p = 0; p < 4; ++p) {
        for (int q = 0; q < 4; ++q) {
          for (int b = 0; b < 3; ++b) {
            to[p] = sum(to[p], along(of.rest + 12 * (3 * q + b) + 3 * p, from[q].at[b]));
          }
        }
      }
    }
    for (int p = 0; p < 4; ++p) add(to[p], of.point[p], y);
  }

  static void friction_product(const FrictionProduct& of, const double* z, double* y) {
    Vector change = zero();
    for (int p = 0; p < of.frame; ++p) {
      if (of.c[p] != 0.0) change = sum(change, scaled(of.c[p], row(z, of.point[p])));
    }
    for (int p = of.frame; p < of.count; ++p) {
      const double* const B = of.B[p - of.frame];
      const Vector z_p = row(z, of.point[p]);
      for (int b = 0; b < 3; ++b) change = sum(change, along(B + 3 * b, z_p.at[b]));
    }
    Vector force = zero();
    for (int b = 0; b < 3; ++b) force = sum(force, along(of.core + 3 * b, change.at[b]));
    for (int p = 0; p < of.frame; ++p) {
      if (of.c[p] != 0.0) add(scaled(of.c[p], force), of.point[p], y);
    }
    for (int p = of.frame; p < of.count; ++p) {
      const double* const B = of.B[p - of.frame];
      add({{dot(B, force), dot(B + 3, force), dot(B + 6, force)}}, of.point[p], y);
    }
    for (int l = 0; l < of.part_count; ++l) {
      const int* const ends = of.edge[l];
      const Vector e1 = edge(z, of.point, ends);
      const Vector e2 = edge(z, of.point, ends + 2);
      add_edge(cross(of.turn[l], e2), of.point, ends, y);
      add_edge(cross(e1, of.turn[l]), of.point, ends + 2, y);
    }
  }

  /// a1 e1 + a2 e2 + a3 m.
  static DIFFCLOTH_INLINE Vector combined(const double (&a)[3],
                                          const Vector& e1,
                                          const Vector& e2,
                                          const Vector& m) {
    return sum(sum(scaled(a[0], e1), scaled(a[1], e2)), scaled(a[2], m));
  }

  static DIFFCLOTH_INLINE Vector by_beta(const double (&by)[3][2], const Number (&beta)[2]) {
    return {{by[0][0] * beta[0] + by[0][1] * beta[1], by[1][0] * beta[0] + by[1][1] * beta[1],
             by[2][0] * beta[0] + by[2][1] * beta[1]}};
  }

  static void friction_tangent(const FrictionTangent& of,
                               const double* lag,
                               const double* start,
                               const double* by_parameters,
                               double* y) {
    // Derivatives by the lag configuration: the coefficients c, the normal and its force.
    Vector x[4];
    Vector t = zero();
    Number share{};
    for (int i = 0; i < 4; ++i) {
      x[i] = row(lag, of.corner[i]);
      t = sum(t, scaled(of.corner_c[i], x[i]));
      share += dot(of.by_corners + 3 * i, x[i]);
    }
    // Vector between the contact points at the start, relative to the first point.
    const Vector origin = row(start, of.point[0]);
    Vector r = zero();
    for (int i = 1; i < of.count; ++i) {
      if (of.c[i] == 0.0) continue;
      r = sum(r, scaled(of.c[i], minus(row(start, of.point[i]), origin)));
    }
    Vector s = zero();
    if (of.slides) {
      Number beta[2] = {};
      for (int b = 0; b < 2; ++b) {
        for (int i = 0; i < 4; ++i) beta[b] += dot(of.beta[b] + 3 * i, x[i]);
      }
      t = sum(t, by_beta(of.t_beta, beta));
      s = by_beta(of.r_beta, beta);
      r = sum(r, by_beta(of.r_start_beta, beta));
      for (int i = 0; i < 4; ++i) {
        const Number c = of.c_beta[i][0] * beta[0] + of.c_beta[i][1] * beta[1];
        add(along(of.force, c), of.corner[i], y);
      }
    }
    const Vector n = scaled(of.inv_d, tangential(t, of.n));

    // r' = r(x_start) + l n.
    Number extension =
        dot(of.extension_by_t, t) + dot(of.extension_by_n, n) + dot(of.extension_by_r, r);
    for (int l = 0; l < of.part_count; ++l) {
      const FrameTangent& part = of.part[l];
      if (!part.turns) continue;
      for (int e = 0; e < 2; ++e) {
        extension += dot(part.extension_by_lag[e], edge(lag, of.point, part.edge + 2 * e));
        extension += dot(part.extension_by_start[e], edge(start, of.point, part.edge + 2 * e));
      }
    }
    r = sum(r, sum(along(of.n, extension), scaled(of.extension, n)));

    // s = r(x) - E(x) a - E_L b, with t and r' in the frames.
    Vector a[2];
    for (int l = 0; l < of.part_count; ++l) {
      const FrameTangent& part = of.part[l];
      a[l] = zero();
      if (!part.turns) {
        s = minus(s, scaled(part.share, r));
        continue;
      }
      const Vector e1 = edge(lag, of.point, part.edge);
      const Vector e2 = edge(lag, of.point, part.edge + 2);
      const Vector m = sum(cross(e1, part.e2_lag), cross(part.e1_lag, e2));
      const Vector own_t = minus(scaled(part.share, t), combined(part.a, e1, e2, m));
      for (int k = 0; k < 3; ++k) a[l].at[k] = dot(part.to_lag[k], own_t);
      s = minus(s, sum(sum(along(part.e1, a[l].at[0]), along(part.e2, a[l].at[1])),
                       along(part.m, a[l].at[2])));

      const Vector e1_start = edge(start, of.point, part.edge);
      const Vector e2_start = edge(start, of.point, part.edge + 2);
      const Vector m_start = sum(cross(e1_start, part.e2_start), cross(part.e1_start, e2_start));
      const Vector own_r =
          minus(scaled(part.share, r), combined(part.b, e1_start, e2_start, m_start));
      Vector turned;
      for (int k = 0; k < 3; ++k) turned.at[k] = dot(part.turn[k], own_r);
      s = minus(s, sum(combined(part.b, e1, e2, m), turned));
    }
    const Vector w =
        minus(minus(tangential(s, of.n), along(of.n, dot(of.s, n))), scaled(of.n_s, n));
    Number more;
    load(by_parameters, more);
    share = share + of.by_w * dot(of.w, w) + more;
    const Vector change = sum(along(of.w, share), scaled(of.stiffness, w));
    for (int i = 0; i < of.count; ++i) {
      if (of.c[i] != 0.0) add(scaled(of.c[i], change), of.point[i], y);
    }
    for (int l = 0; l < of.part_count; ++l) {
      const FrameTangent& part = of.part[l];
      if (!part.turns) continue;
      const Vector by_a_1 =
          sum(scaled(part.a[0], change), scaled(part.a[2], cross(part.e2, change)));
      const Vector by_a_2 =
          sum(scaled(part.a[1], change), scaled(part.a[2], cross(change, part.e1)));
      const Vector by_force_1 = sum(along(of.force, a[l].at[0]), along(part.e2_force, a[l].at[2]));
      const Vector by_force_2 = sum(along(of.force, a[l].at[1]), along(part.force_e1, a[l].at[2]));
      add_edge(scaled(-1.0, sum(by_a_1, by_force_1)), of.point, part.edge, y);
      add_edge(scaled(-1.0, sum(by_a_2, by_force_2)), of.point, part.edge + 2, y);
    }
  }
};

using One = Directions<double, 1>;
using Some = Directions<Pack, kDirectionLanes>;

void contact_products(const ContactProduct& of, const double* z, double* y) {
  for (int l = 0; l < kDirectionLanes; l += kPack) Some::contact_product(of, z + l, y + l);
}

void friction_products(const FrictionProduct& of, const double* z, double* y) {
  for (int l = 0; l < kDirectionLanes; l += kPack) Some::friction_product(of, z + l, y + l);
}

void friction_tangents(const FrictionTangent& of,
                       const double* lag,
                       const double* start,
                       const double* by_parameters,
                       double* y) {
  for (int l = 0; l < kDirectionLanes; l += kPack) {
    Some::friction_tangent(of, lag + l, start + l, by_parameters + l, y + l);
  }
}

constexpr DirectionLevel kKernels{.one = {.lanes = 1,
                                          .contact_product = One::contact_product,
                                          .friction_product = One::friction_product,
                                          .friction_tangent = One::friction_tangent},
                                  .many = {.lanes = kDirectionLanes,
                                           .contact_product = contact_products,
                                           .friction_product = friction_products,
                                           .friction_tangent = friction_tangents}};

}  // namespace
}  // namespace diffcloth::contact

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
