#include "elastic/springs.h"

#include <algorithm>
#include <cstddef>

namespace diffcloth::elastic {
namespace {

double rest_length(const Springs& springs, Index a) {
  return springs.rest_length.empty() ? 0.0 : springs.rest_length[a];
}

/// (|d| - L)^2.
double squared_stretch(const Vec3& d, double rest) {
  const double stretch = rest == 0.0 ? 0.0 : d.norm() - rest;
  return rest == 0.0 ? d.squaredNorm() : stretch * stretch;
}

/// s: the share of d that pulls.
double pull(double length, double rest) {
  if (rest == 0.0) return 1.0;
  return length > 0.0 ? 1.0 - rest / length : 0.0;
}

Vec3 unit_force(const Vec3& d, double rest) {
  return rest == 0.0 ? d : Vec3(pull(d.norm(), rest) * d);
}

Vec3 times_hessian(const Vec3& d, double k, double rest, const Vec3& z) {
  if (rest == 0.0) return k * z;
  const double length = d.norm();
  if (length == 0.0) return Vec3::Zero();
  const Vec3 n = d / length;
  const double along = n.dot(z);
  return k * (along * n + pull(length, rest) * (z - along * n));
}

}  // namespace

void add_to_points(const Springs& springs, Index a, const Vec3& value, double* y) {
  const auto points = springs.points(a);
  const auto b = springs.coefficients(a);
  for (std::size_t p = 0; p < points.size(); ++p) {
    Eigen::Map<Vec3>(y + 3 * points[p]) += b[p] * value;
  }
}

Vec3 difference(const Springs& springs, Index a, const double* v) {
  const auto points = springs.points(a);
  const auto b = springs.coefficients(a);
  Vec3 sum = b[0] * row(v, points[0]);
  for (std::size_t p = 1; p < points.size(); ++p) sum += b[p] * row(v, points[p]);
  return sum;
}

Vec3 extension(const Springs& springs, Index a, const double* x) {
  const Vec3 d = difference(springs, a, x);
  const Index target = springs.target_row[a];
  return target < 0 ? d : Vec3(d - row(springs.target, target));
}

bool has_length(const Springs& springs, Index a) { return rest_length(springs, a) != 0.0; }

Mat3 hessian(const Springs& springs, Index a, const double* x, bool positive) {
  const double k = springs.stiffness[a];
  const double rest = rest_length(springs, a);
  if (rest == 0.0) return k * Mat3::Identity();
  const Vec3 d = extension(springs, a, x);
  const double length = d.norm();
  if (length == 0.0) return Mat3::Zero();
  const Vec3 n = d / length;
  const double s = positive ? std::max(0.0, pull(length, rest)) : pull(length, rest);
  return k * (s * Mat3::Identity() + (1.0 - s) * n * n.transpose());
}

double energy(const Springs& springs, const double* x) {
  double total = 0.0;
  springs.for_each_pulling([&](Index a) {
    const double squared = squared_stretch(extension(springs, a, x), rest_length(springs, a));
    total += 0.5 * springs.stiffness[a] * squared;
  });
  return total;
}

double energy_change(const Springs& springs, const double* x0, const double* x1) {
  double total = 0.0;
  springs.for_each_pulling([&](Index a) {
    const Vec3 step = difference(springs, a, x1) - difference(springs, a, x0);
    const Vec3 d0 = extension(springs, a, x0);
    const Vec3 d1 = extension(springs, a, x1);
    // The change of the squares; the change of the lengths is this number over their sum.
    const double squares = step.dot(d0 + d1);
    const double rest = rest_length(springs, a);
    const double lengths = rest == 0.0 ? 0.0 : d0.norm() + d1.norm();
    const double share = lengths > 0.0 ? 1.0 - 2.0 * rest / lengths : 1.0;
    total += 0.5 * springs.stiffness[a] * squares * share;
  });
  return total;
}

void add_gradient(const Springs& springs, const double* x, double* g) {
  springs.for_each_pulling([&](Index a) {
    const Vec3 d = extension(springs, a, x);
    add_to_points(springs, a, springs.stiffness[a] * unit_force(d, rest_length(springs, a)), g);
  });
}

void add_hessian_product(const Springs& springs, const double* x, const double* z, double* y) {
  springs.for_each_pulling([&](Index a) {
    const Vec3 d = extension(springs, a, x);
    const Vec3 change = difference(springs, a, z);
    add_to_points(springs, a,
                  times_hessian(d, springs.stiffness[a], rest_length(springs, a), change), y);
  });
}

void add_energy_bars(const Springs& springs,
                     const double* x,
                     double seed,
                     double* stiffness_bar,
                     double* target_bar,
                     double* x_bar) {
  for (Index a = 0; a < springs.size(); ++a) {
    const Vec3 d = extension(springs, a, x);
    const double rest = rest_length(springs, a);
    const Vec3 force = seed * springs.stiffness[a] * unit_force(d, rest);
    stiffness_bar[a] += 0.5 * seed * squared_stretch(d, rest);
    add_to_points(springs, a, force, x_bar);
    const Index target = springs.target_row[a];
    if (target >= 0) Eigen::Map<Vec3>(target_bar + 3 * target) -= force;
  }
}

void add_mixed(const Springs& springs,
               const double* x,
               const double* z,
               double* stiffness_bar,
               double* target_bar) {
  for (Index a = 0; a < springs.size(); ++a) {
    const Vec3 d = extension(springs, a, x);
    const Vec3 change = difference(springs, a, z);
    const double rest = rest_length(springs, a);
    stiffness_bar[a] += change.dot(unit_force(d, rest));
    const Index target = springs.target_row[a];
    if (target < 0) continue;
    Eigen::Map<Vec3>(target_bar + 3 * target) -=
        times_hessian(d, springs.stiffness[a], rest, change);
  }
}

void add_tangent(const Springs& springs,
                 const double* x,
                 const double* stiffness_dot,
                 const double* target_dot,
                 double* y) {
  for (Index a = 0; a < springs.size(); ++a) {
    const Vec3 d = extension(springs, a, x);
    const double rest = rest_length(springs, a);
    Vec3 force = stiffness_dot[a] * unit_force(d, rest);
    const Index target = springs.target_row[a];
    if (target >= 0) {
      force -= times_hessian(d, springs.stiffness[a], rest, row(target_dot, target));
    }
    add_to_points(springs, a, force, y);
  }
}

}  // namespace diffcloth::elastic
