#pragma once

#include <vector>

#include "solver/motion.h"
#include "solver/stopping.h"
#include "solver/walk.h"

namespace diffcloth::solver {

struct Outcome {
  Criterion criterion = Criterion::kIterationLimit;
  double residual = 0.0;         ///< displacement rate |p|_inf / h of the last Newton step [m/s]
  double motion_fraction = 1.0;  ///< fraction of the prescribed motion that was reached
  bool certified = false;        ///< converged, at a positive definite Hessian
  Certificate certificate;       ///< certificate of the solution, if certified
  Factor nearby;                 ///< last exact Hessian, for the next solve; may be null
};

/// Data for the first solve of a step, which leaves the start of the step.
struct Departure {
  const PrescribedMotion& motion;
  /// First iterate if the straight path to it is certified free of contact, with prescribed points at
  /// their ends. Null: the start of the step is near a solution, and the solve begins there.
  const std::vector<double>* guess;
};

/// Find a local minimum of the objective near x.
///
/// A solve with a departure begins at the guess, or descends with the projected Hessian and follows the
/// prescribed motion (arrive()). One rule holds for all motions, so that the result is a continuous
/// function of the motion where the motion vanishes.
///
/// @param x          in: a feasible start; out: the last feasible iterate, for every criterion; the
///                   current point of the potentials
/// @param departure  null if the prescribed points of x are at their ends
/// @param nearby     factor of an exact Hessian of a similar objective near x; may be null
///
/// Every segment of the polyline of accepted iterates is free of collisions. Convergence means that the
/// exact Hessian at x itself is positive definite, as its factor proves, and that the Newton step is
/// below the tolerance: a local minimum, not a saddle.
Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const Departure* departure,
                 Factor nearby,
                 Context& context);

}  // namespace diffcloth::solver
