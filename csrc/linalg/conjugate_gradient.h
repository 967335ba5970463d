#pragma once

#include <cstdint>
#include <vector>

#include "linalg/block_pattern.h"
#include "linalg/cholesky.h"

namespace diffcloth::linalg {

/// Sum in the order of the entries.
inline double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

enum class Convergence : std::uint8_t { kConverged, kIterationLimit, kNegativeCurvature };

/// Solve A x = b at the vertices that are not fixed, preconditioned by a factor of a nearby matrix.
///
/// @param fixed      [pattern.size()] vertices left out: x is zero there
/// @param tolerance  on the residual in the preconditioner's norm, relative to b's
/// @param max_iterations  given up before, where it can hardly be enough
/// @param x          in: what the preconditioner makes of b; out: the best iterate, however it ended
[[nodiscard]] Convergence conjugate_gradient(const BlockPattern& pattern,
                                             const double* blocks,
                                             const std::vector<char>& fixed,
                                             const CholeskyFactor& preconditioner,
                                             const std::vector<double>& b,
                                             double tolerance,
                                             int max_iterations,
                                             CholeskyWorkspace& workspace,
                                             std::vector<double>& x);

}  // namespace diffcloth::linalg
