#pragma once

#include <span>

#include "common/types.h"

namespace diffcloth::elastic {

/// Soft pins: springs of rest length zero between vertices and targets,
///
///   E = sum_a k_a / 2 |x_i(a) - c_a|^2.
struct Anchors {
  std::span<const Index> vertex;      ///< [A]
  std::span<const double> stiffness;  ///< [A] k_a [N/m]
  std::span<const double> target;     ///< [A, 3] c_a [m]
};

double energy(const Anchors& anchors, const double* x);

/// Energy at x1 minus energy at x0, without cancellation [J].
double energy_change(const Anchors& anchors, const double* x0, const double* x1);

/// g += grad E(x), [N, 3] [N].
void add_gradient(const Anchors& anchors, const double* x, double* g);

/// blocks += the Hessian; diagonal_slot[i] is the slot of the diagonal block of vertex i.
void add_hessian(const Anchors& anchors, std::span<const Index> diagonal_slot, double* blocks);

/// y += H z.
void add_hessian_product(const Anchors& anchors, const double* z, double* y);

/// stiffness_bar += d/dk_a (z . grad E), target_bar += d/dc_a (z . grad E).
void add_mixed(const Anchors& anchors,
               const double* x,
               const double* z,
               double* stiffness_bar,
               double* target_bar);

}  // namespace diffcloth::elastic
