#pragma once

#include <memory>
#include <vector>

#include "solver/objective.h"

namespace diffcloth::solver {

/// Adjoint of x* = argmin P(x): z = H^-1 b at the free vertices, with H the exact, unprojected
/// Hessian at x*. Zero at prescribed vertices.
///
/// @param factor  of the exact Hessian at a nearby point: the preconditioner of a conjugate
///                gradient solve; a fresh factor at x* takes over where that does not converge
/// @param b       [3 vertex_count]; rows of prescribed vertices are ignored
/// @return false when H is not positive definite at x*: then x* is no local minimum and has no
///         gradient
[[nodiscard]] bool solve_adjoint(const Objective& objective,
                                 const double* x,
                                 const std::vector<contact::Contact>& contacts,
                                 const linalg::CholeskyFactor& factor,
                                 const std::vector<double>& b,
                                 std::vector<double>& z);

}  // namespace diffcloth::solver
