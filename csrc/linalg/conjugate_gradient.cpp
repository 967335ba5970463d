#include "linalg/conjugate_gradient.h"

#include <cmath>

#include "linalg/block_matrix.h"

namespace diffcloth::linalg {
namespace {

/// Residuals seldom shrink more in an iteration: solves in which they would have to are given up.
constexpr double kFastest = 2.5;

}  // namespace

Convergence conjugate_gradient(const BlockPattern& pattern,
                               const double* blocks,
                               const std::vector<char>& fixed,
                               const CholeskyFactor& preconditioner,
                               const std::vector<double>& b,
                               double tolerance,
                               int max_iterations,
                               CholeskyWorkspace& workspace,
                               std::vector<double>& x) {
  const std::size_t size = 3 * static_cast<std::size_t>(pattern.size());
  std::vector<double> z(size, 0.0);
  z.swap(x);
  std::vector<double> r(b.begin(), b.begin() + static_cast<std::ptrdiff_t>(size));
  for (Index i = 0; i < pattern.size(); ++i) {
    if (fixed[i]) r[3 * i] = r[3 * i + 1] = r[3 * i + 2] = 0.0;
  }
  std::vector<double> p = z;
  std::vector<double> q(size);
  double rz = dot(r, z);
  const double goal = tolerance * tolerance * rz;
  if (rz == 0.0) return Convergence::kConverged;

  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    std::fill(q.begin(), q.end(), 0.0);
    add_product(pattern, blocks, p.data(), q.data());
    for (Index i = 0; i < pattern.size(); ++i) {
      if (fixed[i]) q[3 * i] = q[3 * i + 1] = q[3 * i + 2] = 0.0;
    }
    const double curvature = dot(p, q);
    if (!(curvature > 0.0)) return Convergence::kNegativeCurvature;
    const double alpha = rz / curvature;
    for (std::size_t k = 0; k < size; ++k) {
      x[k] += alpha * p[k];
      r[k] -= alpha * q[k];
    }
    preconditioner.solve(r.data(), z.data(), workspace);
    const double next = dot(r, z);
    if (next <= goal) return Convergence::kConverged;
    if (next > goal * std::pow(kFastest * kFastest, max_iterations - 1 - iteration)) break;
    const double beta = next / rz;
    rz = next;
    for (std::size_t k = 0; k < size; ++k) p[k] = z[k] + beta * p[k];
  }
  return Convergence::kIterationLimit;
}

}  // namespace diffcloth::linalg
