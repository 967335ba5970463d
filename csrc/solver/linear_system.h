#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "common/stopwatch.h"
#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"
#include "linalg/conjugate_gradient.h"
#include "solver/objective.h"

namespace diffcloth::solver {

using Factor = std::shared_ptr<const linalg::CholeskyFactor>;

/// A factor of a Hessian. A factor in single precision comes with the Hessian, as a solve to rounding
/// needs both.
struct Certificate {
  Factor factor;  ///< null: no certificate
  std::shared_ptr<const linalg::BlockValues> hessian;

  std::size_t bytes() const;
};

/// Counts of the operations of one step, for the report.
struct Counts {
  int exact = 0;                  ///< Newton steps with the exact Hessian, factored or by CG
  int chord = 0;                  ///< steps with an older factor
  int projected = 0;              ///< steps with a Hessian blended with its projection
  int negative_curvature = 0;     ///< Hessians that were found indefinite
  std::int64_t local_global = 0;  ///< iterations of Projective Dynamics
  int left_to_newton = 0;         ///< solves that Projective Dynamics left to Newton's method
  int factorizations = 0;         ///< numeric factorizations, including failed ones
  int in_doubles = 0;             ///< factorizations in double precision
  int analyses = 0;               ///< symbolic factorizations
};

/// The Newton system H p = -g of an objective at its current point: assembled, factored, solved and
/// certified. Matrices are indexed by the rows of the coordinates, which must be at the same point as
/// the objective.
class LinearSystem {
 public:
  /// @param workspace  for factorizations; the thread reuses it from one system to the next
  LinearSystem(const Objective& objective,
               linalg::CholeskyWorkspace& workspace,
               Stopwatch& watch,
               Counts& counts)
      : f_(objective), workspace_(workspace), watch_(watch), counts_(counts) {}

  /// The Hessian at x, on the couplings of this point and the couplings that the objective expects: a
  /// function of x and these couplings, not of previous iterates.
  ///
  /// @param g  the gradient at x
  linalg::BlockMatrix assemble(const double* x, Curvature curvature, const std::vector<double>& g);

  /// The Hessian at x with extrapolated stresses: see Potential::extrapolate().
  linalg::BlockMatrix assemble_extrapolated(const double* x,
                                            Curvature curvature,
                                            const std::vector<double>& g);

  /// L L^T of a matrix from assemble() at the last point; null if the verdict is not positive.
  ///
  /// @param precision  single is accurate enough for directions, and takes half the time
  Factor factor(const linalg::BlockValues& matrix,
                linalg::Precision precision,
                linalg::Verdict& verdict);

  /// Factor in double precision.
  Factor factor_in_doubles(const linalg::BlockValues& matrix) {
    linalg::Verdict verdict = linalg::Verdict::kUnclear;
    return factor(matrix, linalg::Precision::kDouble, verdict);
  }

  /// Factor in single precision, or in doubles if that fails.
  Factor factor(const linalg::BlockValues& matrix) {
    linalg::Verdict verdict = linalg::Verdict::kUnclear;
    Factor single = factor(matrix, linalg::Precision::kSingle, verdict);
    return single ? single : factor_in_doubles(matrix);
  }

  /// Change p = -factor^-1 (b pulled back to rows) of all points, zero at prescribed ones, as accurate
  /// as the factor.
  ///
  /// @param b  at all points
  void solve(const linalg::CholeskyFactor& factor,
             const std::vector<double>& b,
             std::vector<double>& p);

  /// Refine p, the solution for b by a factor in single precision: the relative error is about squared.
  void refine(const linalg::CholeskyFactor& factor,
              const linalg::BlockValues& matrix,
              const std::vector<double>& b,
              std::vector<double>& p);

  /// Solve to rounding for several right sides at once; each solution has the bits of a separate solve.
  void solve(const Certificate& certificate,
             const std::vector<std::vector<double>>& b,
             std::vector<std::vector<double>>& p);

  /// Solve with a matrix by conjugate gradients, preconditioned by the factor of a nearby matrix.
  ///
  /// @param p  in: the change that this factor yields
  linalg::Convergence solve(const linalg::BlockValues& matrix,
                            const linalg::CholeskyFactor& nearby,
                            const std::vector<double>& b,
                            double tolerance,
                            int max_iterations,
                            std::vector<double>& p);

  /// Factor the exact Hessian at x: the certificate that a point with a vanishing gradient is a minimum.
  /// None if the Hessian is not positive definite.
  ///
  /// @param p  out: the Newton step
  Certificate certify(const double* x, const std::vector<double>& g, std::vector<double>& p);

  /// Check that a factor in single precision may certify. It is replaced by a factor in doubles, or by
  /// none, if it disagrees with its Hessian along the sum of the gradient and a right side without
  /// symmetry. If it agrees, the step is right to a tenth, and the Hessian is definite: a negative
  /// direction hidden by rounding would be the softest of all, and have a large share in the test
  /// vector.
  ///
  /// @param p  the step of the factor for this gradient
  void confirm(Certificate& certificate, const std::vector<double>& g, std::vector<double>& p);

 private:
  bool agrees(const Certificate& certificate,
              const std::vector<double>& g,
              const std::vector<double>& p);

  const Objective& f_;
  linalg::CholeskyWorkspace& workspace_;
  Stopwatch& watch_;
  Counts& counts_;
  std::shared_ptr<const AnalyzedPattern> pattern_;  ///< couplings at x_
  std::vector<double> x_;                           ///< all points
  std::vector<double> b_;
  std::vector<double> z_;
};

}  // namespace diffcloth::solver
