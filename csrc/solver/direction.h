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

/// What a direction was computed with.
enum class Kind : std::uint8_t {
  kFactored,  ///< the exact Hessian, factored here: where it succeeds, the certificate of a minimum
  kIterated,  ///< the exact Hessian, by conjugate gradients
  kPrimalDual,    ///< the same with duals of friction, factored here
  kChord,         ///< a factor of either at an earlier point
  kDamped,        ///< the exact Hessian blended with its projection
  kExtrapolated,  ///< the exact Hessian with extrapolated stresses
};

/// The next direction of a minimization, as cheap as what the last ones have shown allows.
///
/// In this order: a chord step with the last exact factor while that contracts; near the solution, and where
/// a factor is dear after any full step, conjugate gradients on the exact Hessian with that factor; a new
/// factor. Where the exact Hessian H is not positive definite, A(s) = (H + s P) / (1 + s) with its
/// projection P; s falls while steps gain what they promise. After a step across a kink of friction H is the
/// primal-dual Hessian, which remembers the other side; it certifies nothing. All constants are free of units.
///
/// Of several minima a step shall end in one that does not flip with the last bits of its start, so that no
/// direction may amplify those: not one far from the solution with a larger error than near it, as that
/// depends on where iterations end, nor one along which A(s) is barely definite, so that the step is long and
/// any length.
class Directions {
 public:
  /// @param nearby  factor of an exact Hessian that may be close; may be null
  Directions(Walk& walk, Factor nearby)
      : walk_(walk), last_{.factor = std::move(nearby), .hessian = nullptr} {}

  struct Direction {
    Kind kind;
    double first;  ///< fraction to try first: above 1 where a damped step should be longer
  };

  /// Compute the next direction into p(). None where rounding leaves no positive definite Hessian.
  std::optional<Direction> next();

  /// The same, of Hessians with extrapolated stresses; factored, as excursions need exact directions.
  std::optional<Direction> next_extrapolated();

  /// Compute the direction of the projected Hessian. False where rounding leaves it indefinite.
  bool project();

  /// Compute the direction of the exact Hessian, factored here. False where it is indefinite.
  bool certify();

  /// After a step of a new factor: make that a certificate, which is a function of the point alone. False
  /// where the Hessian is indefinite.
  bool confirm();

  const std::vector<double>& p() const { return p_; }
  /// Whether there is a certificate of the point where the walk stands.
  bool is_certified() const { return confirmed_ && last_.factor != nullptr; }

  /// Of the point where certify() or confirm() was true last.
  const Certificate& certificate() const { return last_; }

  /// Whether another factor would take many times as long as a solve with the last one.
  bool is_dear() const;

  /// The share of the projection in damped directions.
  double share() const { return s_; }

  /// Be back where the direction was p, with that share.
  void resume(const std::vector<double>& p, double share) {
    p_ = p;
    s_ = share;
    confirmed_ = false;
  }

  /// Learn from how the last direction was walked.
  void learn(const Direction& direction, const Search& search);

  /// Turn to the next kind of direction, as the last one led nowhere. False when none is left.
  bool retry(Kind kind);

  /// Forget the way here, after a jump.
  void restart();

 private:
  /// The last factor is no longer that of the point where the walk stands.
  void leave();

  /// A new factor is about to be made: drop the last one if it is large.
  void make_room();

  /// Factor a matrix in single precision, or in doubles where that fails.
  ///
  /// @param doubts  whether it may be definite where single precision finds it indefinite; that is
  ///                believed once it was right in this step, and until it was wrong
  Factor factor(const linalg::BlockValues& A, bool doubts);

  /// Factor the exact Hessian. Where it is indefinite the last factor stays, unless it is large.
  ///
  /// @param H  taken where it is definite
  bool refactor(linalg::BlockMatrix& H);

  /// Compute the step of a factor. Far from the solution also without the rounding of single precision,
  /// which would be as good as another start.
  ///
  /// @param A  what it is the factor of
  void solve(const linalg::CholeskyFactor& factor, const linalg::BlockValues& A);

  /// The same, and its slope; where single precision has turned it uphill, by a factor in doubles. Returns the
  /// factor that the step is of; null where that matrix is not positive definite.
  Factor solve_downhill(Factor factor, const linalg::BlockMatrix& A);

  /// Compute the step of the last factor, and whether it does.
  bool chord();

  /// Whether this is near a solution, or the solve has just begun, with the factor of the one before.
  bool is_near() const;

  /// Operations that a factor took for each of its entries; a solve takes a fixed number.
  double operations_per_entry() const;

  /// Whether p() leads away from here.
  bool is_far() const;

  /// p^T H p.
  double curvature_along(const linalg::BlockMatrix& H) const;

  /// Go on from there to that of the exact Hessian H, by conjugate gradients, where those are worth trying.
  bool iterate(const linalg::BlockMatrix& H, bool& indefinite);

  /// The direction of a matrix and its slope; false where the matrix is not positive definite.
  bool descend(const linalg::BlockMatrix& A, bool doubts);
  std::optional<Direction> damp(const linalg::BlockMatrix& H, const linalg::BlockMatrix& P);

  Walk& walk_;
  bool confirmed_ = false;  // that the last one is a certificate
  Certificate last_;  // of the exact Hessian that was factored last; without that once it is left
  std::vector<double> p_;
  double slope_ = 0.0;
  double last_step_ = std::numeric_limits<double>::infinity();
  bool chord_allowed_ = false;  // the last step was a full one with an exact Hessian
  double s_ = 0.0;
};

}  // namespace diffcloth::solver
