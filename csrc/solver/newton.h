#pragma once

#include <vector>

#include "solver/motion.h"
#include "solver/stopping.h"
#include "solver/walk.h"

namespace diffcloth::solver {

struct Outcome {
  Criterion criterion = Criterion::kIterationLimit;
  double residual = 0.0;         ///< |p|_inf / h of the last Newton step [m/s]
  double motion_fraction = 1.0;  ///< of the prescribed motion that was reached
  bool certified = false;        ///< converged, at a Hessian that is positive definite
  Certificate certificate;       ///< at the solution, where certified
  Factor nearby;                 ///< of the last exact Hessian, for the next solve; may be null
};

/// How the first solve of a step leaves the start of the step.
struct Departure {
  const PrescribedMotion& motion;
  /// Point to begin at if the straight way there is certified free of contact, prescribed points at their
  /// ends. Null: the start of the step is near a solution, and a solve begins there.
  const std::vector<double>* guess;
};

/// Find a local minimum of the objective near x.
///
/// A solve with a departure begins at the guess, or descends with the projected Hessian and follows the
/// prescribed motion (arrive()), by one rule for all motions: the result is a continuous function of the
/// motion where the motion vanishes.
///
/// @param x          in: a feasible start; out: the last feasible iterate, whatever the criterion.
///                   The potentials stand there.
/// @param departure  null where the prescribed points of x are at their ends
/// @param nearby     factor of an exact Hessian of a similar objective near x; may be null
///
/// Every segment of the polyline of accepted iterates is free of collisions. Converged means that at
/// x itself the exact Hessian is positive definite, by its factor, and the Newton step below the
/// tolerance: a local minimum, not a saddle.
Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const Departure* departure,
                 Factor nearby,
                 Context& context);

}  // namespace diffcloth::solver
