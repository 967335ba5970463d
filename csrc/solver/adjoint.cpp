#include "solver/adjoint.h"

#include "linalg/conjugate_gradient.h"

namespace diffcloth::solver {
namespace {

/// Residual of the adjoint solve, relative; far below what finite differences can see.
constexpr double kTolerance = 1e-12;
/// Beyond this many iterations a fresh factorization is cheaper.
constexpr int kIterations = 12;

}  // namespace

bool solve_adjoint(const Objective& f,
                   const double* x,
                   const std::vector<contact::Contact>& contacts,
                   const linalg::CholeskyFactor& factor,
                   const std::vector<double>& b,
                   std::vector<double>& z) {
  const Hessian hessian = assemble(f, x, contacts, contact::Curvature::kExact);
  const linalg::BlockPattern& pattern = hessian.assembly->merged.pattern;
  const auto polish = [&](const linalg::CholeskyFactor& preconditioner) {
    return linalg::conjugate_gradient(pattern, hessian.blocks.data(), *f.prescribed, preconditioner,
                                      b, kTolerance, kIterations, z);
  };
  if (!polish(factor)) {
    linalg::CholeskyFactor fresh(hessian.assembly->analysis);
    if (!fresh.compute(hessian.blocks.data())) return false;
    // With the matrix' own factor two iterations reach the floor of rounding, whether or not that
    // is below the tolerance.
    if (!polish(fresh)) fresh.solve(b.data(), z.data());
  }
  z.resize(3 * static_cast<std::size_t>(f.vertex_count), 0.0);
  return true;
}

}  // namespace diffcloth::solver
