#pragma once

#include <span>

#include "bodies/tree.h"

namespace diffcloth::bodies {

/// Weight of a robot as a spring, for steps that lead to an equilibrium.
///
/// The potential energy of the weight, V(x) = -sum_l m_l g . c_l(x), is not quadratic in the
/// coordinates x of a robot. Near x_n it is V(x_n) - Q . d + 1/2 d^T K d, with d = x - x_n and the
/// generalized weight Q. A step that ends where it began, d = 0, ends in an equilibrium for any K. If K
/// is the second derivative of V, the step and the equilibrium have the same derivatives by all inputs.
///
/// Far from an equilibrium the second derivative may be too small: the step along Q then overshoots.
/// With a K that is at least as large everywhere, each step lowers the energy (majorization and
/// minimization; Lange, "MM Optimization Algorithms", SIAM 2016).
///
/// Both return [6 + J, 6 + J], for a shift of the root's center, its rotation vector and the joints.
///
/// @param mass     [L] kg
/// @param gravity  [m/s^2]
MatrixX<double> weight_stiffness(const Tree& tree,
                                 std::span<const double> mass,
                                 const std::vector<PlacedBody<double>>& placed,
                                 const Vec3& gravity);

/// Diagonal upper bound of K for all values of the rotating joints. Sliding joints enter with their
/// present values.
///
/// A rotation moves the center of a link by at most its distance r from the axis along the links
/// between. The second derivative by two rotations is at most the smaller r of both; by a rotation and a
/// shift it is at most one, and by two shifts it is zero.
MatrixX<double> weight_stiffness_bound(const Tree& tree,
                                       std::span<const double> mass,
                                       const std::vector<PlacedBody<double>>& placed,
                                       const Vec3& gravity);

}  // namespace diffcloth::bodies
