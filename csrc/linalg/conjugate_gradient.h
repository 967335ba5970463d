#pragma once

#include <cstdint>
#include <vector>

#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"

namespace diffcloth::linalg {

/// Dot product, summed in the order of the entries.
inline double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

enum class Convergence : std::uint8_t { kConverged, kIterationLimit, kNegativeCurvature };

/// Solve A x = b at the vertices that are not left out of the preconditioner, a factor of a nearby
/// matrix.
///
/// @param tolerance  on the residual in the preconditioner's norm, relative to the norm of b
/// @param fastest    contraction of the residual in an iteration that is seldom exceeded: the solve
/// stops early if the remaining iterations would have to contract more
/// @param x          in: the preconditioner applied to b, zero at vertices left out; out: the last
/// iterate
[[nodiscard]] Convergence conjugate_gradient(const BlockValues& A,
                                             const CholeskyFactor& preconditioner,
                                             const std::vector<double>& b,
                                             double tolerance,
                                             int max_iterations,
                                             double fastest,
                                             CholeskyWorkspace& workspace,
                                             std::vector<double>& x);

/// Apply a factor to several right-hand sides, each with the same bits as alone.
///
/// @param x  zero at vertices left out
void solve(const CholeskyFactor& factor,
           const std::vector<std::vector<double>>& b,
           CholeskyWorkspace& workspace,
           std::vector<std::vector<double>>& x);

/// Test by which a factor in single precision agrees with its matrix.
struct Agreement {
  double first_contraction;  ///< of the residual, by the first iteration
  double residual;           ///< at the end, relative to the first
  int iterations;            ///< to get there
};

/// Return whether the factor of a matrix in single precision is accurate along a right-hand side:
/// conjugate gradients from x must contract the residual as specified by `agreement`. In a direction of
/// negative curvature of A the residual would not decrease.
///
/// @param x  solution by the factor alone
[[nodiscard]] bool agrees(const BlockValues& A,
                          const CholeskyFactor& factor,
                          const std::vector<double>& b,
                          const std::vector<double>& x,
                          const Agreement& agreement,
                          CholeskyWorkspace& workspace);

/// Solve A x = b for several right-hand sides, each with the same bits as alone, with a factor of A
/// itself in single precision. Returns a flag for each: nonzero if converged.
///
/// @param tolerance  on the residual in the factor's norm, relative to the norm of b
/// @param x          zero at vertices left out
[[nodiscard]] std::vector<char> conjugate_gradients(const BlockValues& A,
                                                    const CholeskyFactor& factor,
                                                    const std::vector<std::vector<double>>& b,
                                                    double tolerance,
                                                    int max_iterations,
                                                    CholeskyWorkspace& workspace,
                                                    std::vector<std::vector<double>>& x);

}  // namespace diffcloth::linalg
