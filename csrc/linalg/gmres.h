#pragma once

#include <functional>
#include <vector>

namespace diffcloth::linalg {

/// y = A x for a linear map; x and y do not overlap.
using LinearMap = std::function<void(const std::vector<double>& x, std::vector<double>& y)>;

struct GmresOutcome {
  bool converged;
  int iterations;
};

/// Solve A x = b by GMRES (Saad and Schultz 1986), preconditioned from the left.
///
/// @param apply         A
/// @param precondition  an approximate inverse of A
/// @param tolerance     on the preconditioned residual, relative to the preconditioned b
/// @param x             out: the solution, or the best approximation
GmresOutcome gmres(const LinearMap& apply,
                   const LinearMap& precondition,
                   const std::vector<double>& b,
                   double tolerance,
                   int max_iterations,
                   std::vector<double>& x);

}  // namespace diffcloth::linalg
