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

/// A factor of a Hessian, and that Hessian itself where the factor is in single precision: to solve to
/// rounding takes both.
struct Certificate {
  Factor factor;  ///< null: there is none
  std::shared_ptr<const linalg::BlockValues> hessian;

  std::size_t bytes() const;
};

/// What a step did, for the report.
struct Counts {
  int exact = 0;                  ///< Newton steps with the exact Hessian, factored or by CG
  int chord = 0;                  ///< steps with an older factor
  int projected = 0;              ///< steps with a Hessian blended with its projection
  int negative_curvature = 0;     ///< Hessians that were found indefinite
  std::int64_t local_global = 0;  ///< iterations of Projective Dynamics
  int left_to_newton = 0;         ///< solves that these have given up
  int factorizations = 0;         ///< numeric ones, those that failed included
  int in_doubles = 0;             ///< of these, those in double precision
  int analyses = 0;               ///< symbolic ones
};

/// The Newton system H p = -g of an objective, at the point where it stands: assembled, factored,
/// solved and certified. Matrices live on the rows of the coordinates, which stand where the
/// objective does.
class LinearSystem {
 public:
  /// @param workspace  of the factorizations; kept by the thread from one system to the next
  LinearSystem(const Objective& objective,
               linalg::CholeskyWorkspace& workspace,
               Stopwatch& watch,
               Counts& counts)
      : f_(objective), workspace_(workspace), watch_(watch), counts_(counts) {}

  /// The Hessian at x, on the couplings of this point and those that the objective expects: a function of x
  /// and these, not of the way there.
  ///
  /// @param g  the gradient at x
  linalg::BlockMatrix assemble(const double* x, Curvature curvature, const std::vector<double>& g);

  /// The Hessian at x with extrapolated stresses: see Potential::extrapolate().
  linalg::BlockMatrix assemble_extrapolated(const double* x,
                                            Curvature curvature,
                                            const std::vector<double>& g);

  /// L L^T of a matrix that assemble() has made at the last point; null where the verdict is not positive.
  ///
  /// @param precision  single is enough for directions, and takes half the time
  Factor factor(const linalg::BlockValues& matrix,
                linalg::Precision precision,
                linalg::Verdict& verdict);

  /// The same in doubles.
  Factor factor_in_doubles(const linalg::BlockValues& matrix) {
    linalg::Verdict verdict = linalg::Verdict::kUnclear;
    return factor(matrix, linalg::Precision::kDouble, verdict);
  }

  /// The same in single precision, or in doubles where that fails.
  Factor factor(const linalg::BlockValues& matrix) {
    linalg::Verdict verdict = linalg::Verdict::kUnclear;
    Factor single = factor(matrix, linalg::Precision::kSingle, verdict);
    return single ? single : factor_in_doubles(matrix);
  }

  /// Change p = -factor^-1 (b pulled back to rows) of all points, zero at prescribed ones, as exact as
  /// the factor.
  ///
  /// @param b  at all points
  void solve(const linalg::CholeskyFactor& factor,
             const std::vector<double>& b,
             std::vector<double>& p);

  /// Improve what the factor of a matrix in single precision has made of b: its error shrinks to about the
  /// square.
  void refine(const linalg::CholeskyFactor& factor,
              const linalg::BlockValues& matrix,
              const std::vector<double>& b,
              std::vector<double>& p);

  /// The same to rounding, for several right sides at once, each with the bits that it has alone.
  void solve(const Certificate& certificate,
             const std::vector<std::vector<double>>& b,
             std::vector<std::vector<double>>& p);

  /// The same for a matrix, by conjugate gradients with a factor of a nearby one.
  ///
  /// @param p  in: the change by that factor alone
  linalg::Convergence solve(const linalg::BlockValues& matrix,
                            const linalg::CholeskyFactor& nearby,
                            const std::vector<double>& b,
                            double tolerance,
                            int max_iterations,
                            std::vector<double>& p);

  /// Factor the exact Hessian at x: the certificate that a point where the gradient vanishes is a
  /// minimum. None where it is none.
  ///
  /// @param p  out: the Newton step
  Certificate certify(const double* x, const std::vector<double>& g, std::vector<double>& p);

  /// Make sure that a factor in single precision can certify: replaced by one in doubles, or none, where it
  /// does not agree with its Hessian along the gradient and a right side without symmetry together. Where it
  /// does, the step is right to a tenth, and the Hessian itself definite: a negative direction that
  /// rounding hides is the softest of all, with a large share.
  ///
  /// @param p  the step that the factor makes of the gradient
  void confirm(Certificate& certificate, const std::vector<double>& g, std::vector<double>& p);

 private:
  bool agrees(const Certificate& certificate,
              const std::vector<double>& g,
              const std::vector<double>& p);

  const Objective& f_;
  linalg::CholeskyWorkspace& workspace_;
  Stopwatch& watch_;
  Counts& counts_;
  std::shared_ptr<const AnalyzedPattern> pattern_;  ///< of the couplings at x_
  std::vector<double> x_;                           ///< all points
  std::vector<double> b_;
  std::vector<double> z_;
};

}  // namespace diffcloth::solver
