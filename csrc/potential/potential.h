#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "common/types.h"
#include "linalg/block_matrix.h"
#include "potential/cotangent_store.h"

namespace diffcloth {

/// Kind of Hessian: exact; a positive semi-definite approximation, for use far from the minimum; or
/// exact with duals in place of forces, for potentials with duals.
enum class Curvature : std::uint8_t { kExact, kPositive, kPrimalDual };

/// Vectors z over all points, and the destination of H z for each of them.
struct Products {
  std::span<const double* const> z;
  std::span<double* const> y;

  std::size_t size() const { return z.size(); }
};

/// One term of the objective of a step: an energy of all points, 3 doubles each: vertices of cloths,
/// then of bodies, followed by the nodes of coordinates.
///
/// A potential stands at one point at a time. stand_at(x) computes the data of that point (the contacts
/// in reach); the functions below that take `x` must be called with that point.
class Potential {
 public:
  Potential() = default;
  virtual ~Potential() = default;
  Potential(const Potential&) = delete;
  Potential& operator=(const Potential&) = delete;

  virtual void stand_at(const double* /*x*/) {}

  /// P(x) [J]; 0 for a potential that defines differences only.
  virtual double energy(const double* x) const = 0;

  /// P(to) - P(x) [J], summed over changes of elements to limit cancellation. NaN or +infinity: not
  /// feasible.
  virtual double energy_change(const double* x, const double* to) const = 0;

  /// g += grad P over all vertices [N].
  virtual void add_gradient(const double* x, double* g) const = 0;

  /// Append the couplings (row > column) of vertices at this point that the base pattern of the linear
  /// system may lack. Unordered; may repeat.
  virtual void add_couplings(std::vector<std::pair<Index, Index>>& /*pairs*/) const {}

  /// A += the Hessian; A leaves out rows that are not part of the system.
  virtual void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const = 0;

  /// Store the stresses at `to` that a linear model of the straight motion x -> `to` predicts.
  virtual void extrapolate(const double* /*x*/, const double* /*to*/) {}

  /// A += the Hessian with the stresses of the last extrapolate() minus the Hessian with the actual
  /// ones, at the end of the last motion. With kPositive the sum with a positive Hessian remains
  /// positive.
  virtual void add_extrapolation(const double* /*x*/,
                                 Curvature /*curvature*/,
                                 linalg::BlockMatrix& /*A*/) const {}

  /// Update the duals after a step from x along p, by the fraction alpha, to a point: the forces of the
  /// step's linear model at its end. They are kept only if they differ from the actual forces.
  virtual void update_duals(const double* /*x*/,
                            const double* /*p*/,
                            double /*alpha*/,
                            const double* /*to*/) {}

  /// Largest change of the forces along a small change p of all points, relative to the bound of the
  /// forces; 0 for potentials without such a bound.
  virtual double force_change(const double* /*x*/, const double* /*p*/) const { return 0.0; }

  /// True if there are duals for this point.
  virtual bool has_duals(const double* /*x*/) const { return false; }

  /// y += H z over all vertices, exact.
  virtual void add_hessian_product(const double* x, const double* z, double* y) const = 0;

  /// y_k += H z_k for several vectors, each with the same bits as alone.
  virtual void add_hessian_products(const double* x, const Products& products) const {
    for (std::size_t l = 0; l < products.size(); ++l) {
      add_hessian_product(x, products.z[l], products.y[l]);
    }
  }

  /// y += H z, exact, at all points except free vertices of cloths; the values at those are undefined.
  virtual void add_held_product(const double* x, const double* z, double* y) const {
    add_hessian_product(x, z, y);
  }

  /// y_k += H z_k for motions z_k of points whose rows add_hessian() leaves out, from pairs with points
  /// that move; each with the same bits as alone.
  virtual void add_left_out_products(const double* /*x*/,
                                     Curvature /*curvature*/,
                                     const Products& /*products*/) const {}

  /// Add -d/d(theta) (z . grad P) to the potential's cotangents of its inputs theta.
  virtual void accumulate(const double* x, const double* z) = 0;

  /// y += d/d(theta) (grad P) theta_dot over all vertices: change of the gradient with the inputs theta,
  /// for tangents theta_dot stored in the potential by its owner. The transpose of accumulate().
  virtual void add_tangent(const double* x, double* y) const = 0;

  /// Call store.exchange() for each cotangent, so that several losses can share one potential. A
  /// potential without cotangents, or whose owner swaps them, does nothing.
  virtual void swap_cotangents(CotangentStore& store) = 0;
};

}  // namespace diffcloth
