#pragma once

#include <vector>

#include "solver/linear_system.h"

namespace diffcloth::solver {

/// Adjoint of x* = argmin P(x): z = H^-1 b at the free vertices, with H the exact, unprojected
/// Hessian at x*. Zero at prescribed vertices. The potentials stand at x*.
///
/// @param factor  of H, as the minimization has left it
/// @param b       [3 vertex_count]; rows of prescribed vertices are ignored
void solve_adjoint(LinearSystem& system,
                   const double* x,
                   const linalg::CholeskyFactor& factor,
                   const std::vector<double>& b,
                   std::vector<double>& z);

}  // namespace diffcloth::solver
