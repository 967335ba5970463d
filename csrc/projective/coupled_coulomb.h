#pragma once

#include <vector>

#include <Eigen/Core>

#include "common/types.h"

namespace diffcloth::projective {

/// Where the law of Signorini and Coulomb holds, and how rough it is there.
struct RoughPlane {
  Vec3 normal;
  double friction;  ///< mu
};

/// Find impulses r and velocities u = q + W r that obey the law at each of several contacts, by block
/// Gauss-Seidel iterations: each contact in turn is solved exactly with the impulses of all others
/// (Moreau 1999; Jean 1999). They settle the cases; Newton's method on all contacts, tried now and then,
/// settles the rest.
///
/// A solution exists for every friction, as each contact can be kept on its own (Acary et al. 2011).
/// Where much of the normal impulses comes from friction, these iterations need not find it.
///
/// @param W  [3 m, 3 m] symmetric, positive definite [1/kg]
/// @param q  [3 m] velocities without impulses [m/s]
/// @param tolerance   on the change of a sweep, relative to that of all sweeps
/// @param max_sweeps  after which the impulses found so far must do
/// @param r  in: a guess; out: the impulses [3 m] [N s]
/// @return whether the tolerance was reached
bool solve_coulomb(const Eigen::MatrixXd& W,
                   const Eigen::VectorXd& q,
                   const std::vector<RoughPlane>& planes,
                   double tolerance,
                   int max_sweeps,
                   Eigen::VectorXd& r);

/// The same for one contact: r with u = b + A r.
///
/// @param last  of several impulses that slip, one whose direction is near this one's is taken
Vec3 solve_coulomb(const Mat3& A, const Vec3& b, const RoughPlane& plane, const Vec3& last);

}  // namespace diffcloth::projective
