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

/// The exact Hessian; a positive semi-definite stand-in for it far from the minimum; or the exact one with
/// duals in the place of forces, where a potential keeps some.
enum class Curvature : std::uint8_t { kExact, kPositive, kPrimalDual };

/// Vectors z over all points, and what H z is added to for each of them.
struct Products {
  std::span<const double* const> z;
  std::span<double* const> y;

  std::size_t size() const { return z.size(); }
};

/// One term of what a step minimizes: an energy of all points, 3 doubles each: vertices, cloth first,
/// then bodies, and behind them the nodes of coordinates.
///
/// A potential stands at one point at a time. stand_at(x) finds what belongs to that point (the
/// contacts in reach); the functions below that take `x` are asked for that point.
class Potential {
 public:
  Potential() = default;
  virtual ~Potential() = default;
  Potential(const Potential&) = delete;
  Potential& operator=(const Potential&) = delete;

  virtual void stand_at(const double* /*x*/) {}

  /// P(x) [J]; 0 for a potential of which only differences have a meaning.
  virtual double energy(const double* x) const = 0;

  /// P(to) - P(x) [J], element by element so that little cancels. NaN or +infinity: not feasible.
  virtual double energy_change(const double* x, const double* to) const = 0;

  /// g += grad P over all vertices [N].
  virtual void add_gradient(const double* x, double* g) const = 0;

  /// Append the couplings (row > column) of vertices that the potential has here and that the base
  /// pattern of the linear system need not have. Any order, repeated or not.
  virtual void add_couplings(std::vector<std::pair<Index, Index>>& /*pairs*/) const {}

  /// A += the Hessian; A leaves out the rows that are not its own.
  virtual void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const = 0;

  /// Points have moved straight from x to `to`: remember the stresses that a linear model of the motion
  /// has there.
  virtual void extrapolate(const double* /*x*/, const double* /*to*/) {}

  /// A += the Hessian with the stresses of the last extrapolate() less that with the actual ones, where
  /// the last motion ended. The positive one leaves a positive Hessian positive.
  virtual void add_extrapolation(const double* /*x*/,
                                 Curvature /*curvature*/,
                                 linalg::BlockMatrix& /*A*/) const {}

  /// A step has led from x along p, by the fraction alpha, to a point: keep the forces that the linear model
  /// of the step has there, its duals, if they differ from those of the point.
  virtual void update_duals(const double* /*x*/,
                            const double* /*p*/,
                            double /*alpha*/,
                            const double* /*to*/) {}

  /// Largest change of its forces along a small change p of all points, as a share of what they can be at
  /// most; of potentials without such a bound none.
  virtual double force_change(const double* /*x*/, const double* /*p*/) const { return 0.0; }

  /// Whether there are duals of this point.
  virtual bool has_duals(const double* /*x*/) const { return false; }

  /// y += H z over all vertices, exact.
  virtual void add_hessian_product(const double* x, const double* z, double* y) const = 0;

  /// The same for several vectors, each with the bits that it has alone.
  virtual void add_hessian_products(const double* x, const Products& products) const {
    for (std::size_t l = 0; l < products.size(); ++l) {
      add_hessian_product(x, products.z[l], products.y[l]);
    }
  }

  /// y += the rows of H z at all points but the cloths' free vertices, exact; what those get means
  /// nothing.
  virtual void add_held_product(const double* x, const double* z, double* y) const {
    add_hessian_product(x, z, y);
  }

  /// y += H z, of the pairs with points that move in z, for motions z of points whose rows
  /// add_hessian() leaves out; each with the bits that it has alone.
  virtual void add_left_out_products(const double* /*x*/,
                                     Curvature /*curvature*/,
                                     const Products& /*products*/) const {}

  /// Add -d/d(theta) (z . grad P) to the cotangents that the potential keeps for its inputs theta.
  virtual void accumulate(const double* x, const double* z) = 0;

  /// y += d/d(theta) (grad P) theta_dot over all vertices: how the gradient changes with the inputs theta,
  /// for the tangents theta_dot that the owner has put into the potential. What accumulate() does,
  /// transposed.
  virtual void add_tangent(const double* x, double* y) const = 0;

  /// Call store.exchange() for each of these cotangents: several losses take turns with one potential. A
  /// potential that keeps none, or whose owner swaps them, has none to show.
  virtual void swap_cotangents(CotangentStore& store) = 0;
};

}  // namespace diffcloth
