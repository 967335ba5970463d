#pragma once

#include <cstdint>
#include <vector>

#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"

namespace diffcloth::linalg {

/// Sum in the order of the entries.
inline double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

enum class Convergence : std::uint8_t { kConverged, kIterationLimit, kNegativeCurvature };

/// Solve A x = b at the vertices that a factor of a nearby matrix does not leave out, preconditioned by
/// it.
///
/// @param tolerance  on the residual in the preconditioner's norm, relative to b's
/// @param fastest    contraction of the residual in an iteration that is seldom exceeded: the solve is given
///                   up early if the remaining iterations would have to contract more
/// @param x          in: what the preconditioner makes of b, zero at vertices left out; out: the best
///                   iterate, however it ended
[[nodiscard]] Convergence conjugate_gradient(const BlockValues& A,
                                             const CholeskyFactor& preconditioner,
                                             const std::vector<double>& b,
                                             double tolerance,
                                             int max_iterations,
                                             double fastest,
                                             CholeskyWorkspace& workspace,
                                             std::vector<double>& x);

/// What a factor makes of several right sides, each with the bits that it has alone.
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

/// Test whether the factor of a matrix in single precision stands for it along a right side: conjugate gradients
/// from x contract the residual as agreed. A direction in which A is negative would keep its share of the
/// residual.
///
/// @param x  solution by the factor alone
[[nodiscard]] bool agrees(const BlockValues& A,
                          const CholeskyFactor& factor,
                          const std::vector<double>& b,
                          const std::vector<double>& x,
                          const Agreement& agreement,
                          CholeskyWorkspace& workspace);

/// Solve A x = b for several right sides, each with the bits that it has alone, with a factor of A itself in
/// single precision; which of them have converged.
///
/// @param tolerance  on the residual in the factor's norm, relative to b's
/// @param x          zero at vertices left out
[[nodiscard]] std::vector<char> conjugate_gradients(const BlockValues& A,
                                                    const CholeskyFactor& factor,
                                                    const std::vector<std::vector<double>>& b,
                                                    double tolerance,
                                                    int max_iterations,
                                                    CholeskyWorkspace& workspace,
                                                    std::vector<std::vector<double>>& x);

}  // namespace diffcloth::linalg
