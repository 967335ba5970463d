#include "solver/adjoint.h"

namespace diffcloth::solver {
namespace {

/// Residual of the adjoint solve, relative; far below what finite differences can see.
constexpr double kTolerance = 1e-12;
/// With the matrix' own factor two iterations reach the floor of rounding.
constexpr int kIterations = 2;

}  // namespace

void solve_adjoint(LinearSystem& system,
                   const double* x,
                   const linalg::CholeskyFactor& factor,
                   const std::vector<double>& b,
                   std::vector<double>& z) {
  const linalg::BlockMatrix H = system.assemble(x, Curvature::kExact);
  system.solve(H, factor, b, kTolerance, kIterations, z);
  for (double& value : z) value = -value;
}

}  // namespace diffcloth::solver
