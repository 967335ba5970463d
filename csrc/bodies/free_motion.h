#pragma once

#include <vector>

#include "bodies/small_solve.h"
#include "bodies/tree.h"

namespace diffcloth::bodies {

/// Orientation of the root and values of the joints. The position of the root's center of mass is not
/// needed.
template <class T>
struct Configuration {
  Matrix3<T> rotation;  ///< of the root
  VectorX<T> joints;
};

/// Configuration after a time at constant velocities.
///
/// @param root_moves  true if the root follows its velocity; otherwise it stays
template <class T>
Configuration<T> moved(const Configuration<T>& start,
                       const VectorX<T>& nu,
                       double time,
                       bool root_moves) {
  const auto joints = static_cast<Eigen::Index>(start.joints.size());
  Configuration<T> end = start;
  end.joints += T(time) * nu.tail(joints);
  if (!root_moves) return end;
  const Vector3<T> turn = T(time) * nu.template segment<3>(3);
  end.rotation = quaternion_matrix<T>(quaternion_exp<T>(turn)) * start.rotation;
  return end;
}

/// Momentum and slope of constant velocities at the middle of a step.
template <class T>
TreeRates<T> rates_at_middle(const Tree& tree,
                             const TreeInertia<T>& inertia,
                             const Configuration<T>& start,
                             const VectorX<T>& nu,
                             double dt,
                             bool root_moves) {
  const Configuration<T> middle = moved<T>(start, nu, 0.5 * dt, root_moves);
  return rates<T>(tree, inertia, place<T>(tree, inertia, middle.rotation, middle.joints), nu);
}

/// Equation for the velocities nu of a tree over a step. With the momentum at the start and the impulse of
/// all forces in `given`:
///
///   r(nu) = p(q_mid, nu) - h/2 s(q_mid, nu) - given = 0
///
/// in the rows that are solved for, where p is the momentum, s = dT/dq the slope of the kinetic energy
/// at constant nu, and q_mid the middle of the step.
template <class T>
struct FreeMotion {
  const Tree& tree;
  const std::vector<Index>& solved;  ///< rows of nu that are unknown
  bool root_moves;
  double dt;
  TreeInertia<T> inertia;
  Configuration<T> start;
  VectorX<T> known;  ///< nu in prescribed rows, zero elsewhere
  VectorX<T> given;

  VectorX<T> complete(const VectorX<T>& x) const {
    VectorX<T> nu = known;
    for (std::size_t k = 0; k < solved.size(); ++k) nu[solved[k]] = x[static_cast<Index>(k)];
    return nu;
  }

  VectorX<T> residual(const VectorX<T>& x) const {
    const VectorX<T> nu = complete(x);
    const TreeRates<T> at = rates_at_middle<T>(tree, inertia, start, nu, dt, root_moves);
    const VectorX<T> r = at.momentum - T(0.5 * dt) * at.slope - given;
    return pick(r, solved);
  }
};

/// Solve by Broyden's method, starting from the velocities of M(q_n) without velocity products.
///
/// @return true if it converged
bool solve(const FreeMotion<double>& motion, Eigen::VectorXd& x);

}  // namespace diffcloth::bodies
