#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "solver/line_search.h"
#include "solver/walk.h"

namespace diffcloth::solver {

/// The matrix from which a direction was computed.
enum class Kind : std::uint8_t {
  kFactored,      ///< the exact Hessian, factored here; its factor certifies a minimum
  kIterated,      ///< the exact Hessian, solved by conjugate gradients
  kPrimalDual,    ///< the exact Hessian with duals of friction, factored here
  kChord,         ///< a factor of one of these at an earlier point
  kDamped,        ///< the exact Hessian blended with its projection
  kExtrapolated,  ///< the exact Hessian with extrapolated stresses
};

/// Computes the next search direction at the lowest cost that the previous steps justify.
///
/// In this order: a chord step with the last exact factor while chord steps contract; near the solution,
/// and after any full step if a factor is expensive, conjugate gradients on the exact Hessian,
/// preconditioned by that factor; a new factor. If the exact Hessian H is not positive definite, A(s) =
/// (H + s P) / (1 + s) with its projection P; s falls while steps gain as predicted. After a step across
/// a kink of friction, H is the primal-dual Hessian, which includes the other side of the kink and
/// certifies nothing. All constants are free of units.
///
/// A search direction must not amplify rounding in the initial state; otherwise a step with several
/// minima may switch between them. Therefore a direction far from the solution has no larger error than
/// one near it, as this error depends on the iteration at which a solver stops; and a direction along
/// which A(s) is barely definite is rejected, as the step is long and its length arbitrary.
class Directions {
 public:
  /// @param nearby  factor of an exact Hessian that may be close; may be null
  Directions(Walk& walk, Factor nearby)
      : walk_(walk), last_{.factor = std::move(nearby), .hessian = nullptr} {}

  struct Direction {
    Kind kind;
    double first;  ///< fraction of the first trial: above 1 if a damped step should be longer
  };

  /// Compute the next direction into p(). None if rounding leaves no positive definite Hessian.
  std::optional<Direction> next();

  /// Likewise, for Hessians with extrapolated stresses; always factored, as excursions need exact
  /// directions.
  std::optional<Direction> next_extrapolated();

  /// Compute the direction of the projected Hessian. False if rounding makes it indefinite.
  bool project();

  /// Compute the direction of the exact Hessian, factored here. False if it is indefinite.
  bool certify();

  /// Turn the factor of the last step, computed here, into a certificate, which is a function of the
  /// point alone. False if the Hessian is indefinite.
  bool confirm();

  const std::vector<double>& p() const { return p_; }
  /// True if the current iterate has a certificate.
  bool is_certified() const { return confirmed_ && last_.factor != nullptr; }

  /// Certificate of the point at which certify() or confirm() last returned true.
  const Certificate& certificate() const { return last_; }

  /// True if a new factor would take many times as long as a solve with the last one.
  bool is_dear() const;

  /// The share of the projection in damped directions.
  double share() const { return s_; }

  /// Restore search direction p and its share of the projection.
  void resume(const std::vector<double>& p, double share) {
    p_ = p;
    s_ = share;
    confirmed_ = false;
  }

  /// Update the share and the chord condition from the line search along the last direction.
  void learn(const Direction& direction, const Search& search);

  /// Switch to the next kind of direction after a failed search. False if none is left.
  bool retry(Kind kind);

  /// Reset the state that depends on previous steps, after a jump.
  void restart();

 private:
  /// Invalidate the certificate: the iterate changes, and the last factor belongs to an earlier point.
  void leave();

  /// Drop the last factor before a new one is computed, if it is large.
  void make_room();

  /// Factor a matrix in single precision, or in doubles where that fails.
  ///
  /// @param doubts  true if the matrix may be definite although single precision finds it indefinite.
  ///                Without doubts, that verdict is believed once it was right in this step, and until
  ///                it was wrong.
  Factor factor(const linalg::BlockValues& A, bool doubts);

  /// Factor the exact Hessian. If it is indefinite, the last factor is kept, unless it is large.
  ///
  /// @param H  consumed if it is definite
  bool refactor(linalg::BlockMatrix& H);

  /// Compute the step with a factor. Far from the solution, a step in single precision is refined, as
  /// its rounding would act like another initial state.
  ///
  /// @param A  the matrix of the factor
  void solve(const linalg::CholeskyFactor& factor, const linalg::BlockValues& A);

  /// Like solve(), and compute the slope; if rounding in single precision makes the step uphill, repeat
  /// it with a factor in doubles. Returns the factor of the step; null if the matrix is not positive
  /// definite.
  Factor solve_downhill(Factor factor, const linalg::BlockMatrix& A);

  /// Compute the chord step of the last factor. True if the step is accepted.
  bool chord();

  /// True near a solution, and at the begin of a solve, which has the last factor of the previous solve.
  bool is_near() const;

  /// Operations of the factorization for each entry of the factor; a solve takes a fixed number.
  double operations_per_entry() const;

  /// True if p() moves a point by more than a step near a solution may.
  bool is_far() const;

  /// p^T H p.
  double curvature_along(const linalg::BlockMatrix& H) const;

  /// Continue from the step of the last factor to the step of the exact Hessian H, by conjugate
  /// gradients. False if they are not worth trying or do not converge in time.
  bool iterate(const linalg::BlockMatrix& H, bool& indefinite);

  /// Compute the direction of A and its slope. False if A is not positive definite.
  bool descend(const linalg::BlockMatrix& A, bool doubts);
  std::optional<Direction> damp(const linalg::BlockMatrix& H, const linalg::BlockMatrix& P);

  Walk& walk_;
  bool confirmed_ = false;  // the last factor is a certificate
  Certificate last_;  // last factored exact Hessian; without the matrix once the iterate has moved
  std::vector<double> p_;
  double slope_ = 0.0;
  double last_step_ = std::numeric_limits<double>::infinity();
  bool chord_allowed_ = false;  // the last step was a full one with an exact Hessian
  double s_ = 0.0;
};

}  // namespace diffcloth::solver
