#pragma once

#include <span>

#include "common/types.h"

namespace diffcloth::elastic {

/// Springs between two points, or between a point and a given target:
///
///   E = sum_a k_a / 2 (|d_a| - L_a)^2,    d_a = sum_p b_p x_p - c_a.
///
/// The sum is over the points of spring a. Points of the second end have negative coefficients, and
/// there is then no c_a. A point of a triangle is a sum over its corners; a point of a rigid body is an
/// affine combination of four of its vertices, which follows every motion of the body exactly. The
/// coefficients of an end add to one, so that the forces of a spring add to zero, and so do their
/// moments.
///
/// With n = d/|d| and s = 1 - L/|d|, the derivatives along d are
///
///   grad E = k s d,    grad^2 E = k (n n^T + s (I - n n^T)),
///
/// and the derivatives along x are these times b_p (and b_q). For L = 0, s is one. A spring shorter than
/// L has s < 0 and pushes; the positive Hessian then has zero instead of s. For d = 0 and L > 0 no
/// direction is distinguished: the spring has neither force nor Hessian.
///
/// Soft pins are springs between one vertex and a target, with L = 0.
struct Springs {
  std::span<const Index> start;         ///< [A + 1] of the points of each spring
  std::span<const Index> point;         ///< [start.back()]
  std::span<const double> coefficient;  ///< likewise, b
  std::span<const double> stiffness;    ///< [A] k [N/m], the weight included
  std::span<const double> rest_length;  ///< [A] L [m]; empty: zero
  std::span<const Index> target_row;    ///< [A] row of the target, -1: none
  const double* target;                 ///< [rows, 3] c [m]

  Index size() const { return static_cast<Index>(start.size()) - 1; }
  /// Visit the springs with nonzero stiffness: pickers have one for each vertex, most of them released.
  template <class Visit>
  void for_each_pulling(Visit&& visit) const {
    for (Index a = 0; a < size(); ++a) {
      if (stiffness[a] != 0.0) visit(a);
    }
  }
  std::span<const Index> points(Index a) const {
    return point.subspan(start[a], start[a + 1] - start[a]);
  }
  std::span<const double> coefficients(Index a) const {
    return coefficient.subspan(start[a], start[a + 1] - start[a]);
  }
};

/// Sum of b_p v_p over the points of a spring, for rows v.
Vec3 difference(const Springs& springs, Index a, const double* v);

/// y_p += b_p value at the points of a spring: difference(), transposed.
void add_to_points(const Springs& springs, Index a, const Vec3& value, double* y);

/// d of a spring.
Vec3 extension(const Springs& springs, Index a, const double* x);

/// True if a spring has a rest length, so that it resists rates along d alone.
bool has_length(const Springs& springs, Index a);

/// The second derivative of one spring along d; if `positive`, its semi-definite part.
Mat3 hessian(const Springs& springs, Index a, const double* x, bool positive);

double energy(const Springs& springs, const double* x);

/// Energy at x1 minus energy at x0, without cancellation [J].
double energy_change(const Springs& springs, const double* x0, const double* x1);

/// g += grad E(x), [points, 3] [N].
void add_gradient(const Springs& springs, const double* x, double* g);

/// y += H z.
void add_hessian_product(const Springs& springs, const double* x, const double* z, double* y);

/// stiffness_bar += seed dE/dk_a, target_bar += seed dE/dc, x_bar += seed grad E.
void add_energy_bars(const Springs& springs,
                     const double* x,
                     double seed,
                     double* stiffness_bar,
                     double* target_bar,
                     double* x_bar);

/// stiffness_bar += d/dk_a (z . grad E), target_bar += d/dc (z . grad E).
void add_mixed(const Springs& springs,
               const double* x,
               const double* z,
               double* stiffness_bar,
               double* target_bar);

/// y += d/dk_a (grad E) k_dot_a + d/dc (grad E) c_dot.
void add_tangent(const Springs& springs,
                 const double* x,
                 const double* stiffness_dot,
                 const double* target_dot,
                 double* y);

}  // namespace diffcloth::elastic
