#pragma once

#include <vector>

#include <Eigen/Core>

#include "common/types.h"

namespace diffcloth::projective {

/// Tangent plane of a contact, with its friction coefficient.
struct RoughPlane {
  Vec3 normal;
  double friction;  ///< mu
};

/// Find impulses r and velocities u = q + W r that obey the law at each of several contacts, by block
/// Gauss-Seidel iterations: each contact in turn is solved exactly with the impulses of all others
/// (Moreau 1999; Jean 1999). The sweeps determine the cases; Newton's method on all contacts, tried at
/// intervals, then converges within these.
///
/// A solution exists for every friction coefficient, as each contact can be kept on its own (Acary et
/// al. 2011). If friction causes much of the normal impulses, these iterations may fail to find it.
///
/// @param W  [3 m, 3 m] symmetric, positive definite [1/kg]
/// @param q  [3 m] velocities without impulses [m/s]
/// @param tolerance   on the change in a sweep, relative to the change in all sweeps
/// @param max_sweeps  limit of the number of sweeps
/// @param r  in: a guess; out: the impulses [3 m] [N s]
/// @return true if the tolerance was reached
bool solve_coulomb(const Eigen::MatrixXd& W,
                   const Eigen::VectorXd& q,
                   const std::vector<RoughPlane>& planes,
                   double tolerance,
                   int max_sweeps,
                   Eigen::VectorXd& r);

/// Solve the law at one contact: r with u = b + A r.
///
/// @param last  initial direction: if several slipping impulses exist, one with a nearby direction is
/// returned
Vec3 solve_coulomb(const Mat3& A, const Vec3& b, const RoughPlane& plane, const Vec3& last);

}  // namespace diffcloth::projective
