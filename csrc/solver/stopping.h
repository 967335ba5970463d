#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <numbers>

#include "linalg/conjugate_gradient.h"

/// Stopping criteria and step-size constants of all solvers. Constants without a unit are counts, shares or
/// ratios.
namespace diffcloth::solver {

/// The criterion that ended a solve; the first two mean that it converged.
enum class Criterion : std::uint8_t {
  kTolerance,       ///< the Newton step (local/global: the residual) is below the tolerance
  kRounding,        ///< likewise, and rounding hides any further progress
  kIterationLimit,  ///< the iterations of the step are used up
  kTimeLimit,       ///< the time of the step is used up
  kPrecisionLimit,  ///< rounding hides steps above the tolerance: no gain or no change of a coordinate
  kNoDescent,       ///< no step along the last direction lowers the objective, however short
  kBlocked,         ///< collision detection leaves no part of the last direction
  kIndefinite,      ///< the projected Hessian has no factor
  kNotFinite,       ///< the gradient is not finite
  kSaddle,          ///< the gradient vanishes where the Hessian is indefinite
  kNoSolution,      ///< friction at nodes: no descent is left, and the law is not satisfied
  kStuckMotion,     ///< the prescribed motion no longer advances
  kNoSolve,         ///< nothing was solved, as surfaces intersect at the start
};

/// Names of the criteria in Python, in the order of Criterion.
inline constexpr std::array kCriterionNames{
    "tolerance",   "rounding",     "iteration_limit", "time_limit", "precision_limit",
    "no_descent",  "blocked",      "indefinite",      "not_finite", "saddle",
    "no_solution", "stuck_motion", "no_solve",
};
static_assert(kCriterionNames.size() == static_cast<std::size_t>(Criterion::kNoSolve) + 1);

constexpr bool has_converged(Criterion criterion) {
  return criterion == Criterion::kTolerance || criterion == Criterion::kRounding;
}

namespace stopping {

/// Newton's method: newton.cpp.
struct Newton {
  /// Share of the tolerance below which a step is not taken: it would cost a solve, and the gradient needs
  /// no more accuracy.
  double settled = 0.1;
  /// Share of the tolerance below which a certified step is not taken: its end needs another factorization.
  double settled_factored = 0.25;
  /// Change of friction, as a share of the largest force, above which even a short step is taken: a few
  /// times the tolerance turn sticking into slipping.
  double force_change = 1e-3;
  /// Ratio of successive certified steps above which the remaining step is assumed to be rounding.
  double contraction = 0.5;
  /// Share of the largest coordinate below which a step is lost in rounding.
  double resolution = 1e-15;
  /// Exact steps whose gain drowns in rounding and that do not shrink, after which the solve ends.
  int idle_steps = 5;
  /// Ratio to the shortest step so far below which a step has shrunk.
  double progress = 0.9;
};
inline constexpr Newton kNewton;

/// Excursions, which may raise the objective for some steps: newton.cpp.
struct Excursions {
  /// Steps within which an excursion must end below its start: the valleys that it follows need fewer.
  int steps = 6;
  /// Share that collisions must leave of each of its steps: shorter steps do not relax the stretch.
  double free = 0.3;
  /// Share of an edge that the first step must exceed in contact: barriers resist shorter ones.
  double far = 0.03;
  /// Largest motion of bodies and links in each step, in edges of the cloths: otherwise friction would
  /// lead a body that it holds around its support, into free fall.
  double farthest = 10.0;
  /// Steps of a solve before the first excursion: most solves end sooner.
  int patience = 8;
  /// Most ordinary steps after a failed excursion; each failure doubles them.
  int longest_wait = 64;
};
inline constexpr Excursions kExcursions;

/// The line search: line_search.cpp.
struct LineSearch {
  /// Armijo's share of the decrease that the slope predicts.
  double armijo = 1e-4;
  /// Share of the slope that must vanish if the decrease drowns in rounding (approximate Wolfe condition).
  double wolfe_slope = 0.8;
  /// Relative change of the energy for which rounding may account.
  double energy_noise = 1e-11;
  /// Multiple of that noise for which rounding cannot account, even if the work of friction is unknown.
  double clearly = 1e3;
  /// Halvings of the step, after which it is lost in the rounding of the coordinates.
  int backtracks = 40;
};
inline constexpr LineSearch kLineSearch;

/// Collision-free steps along curves: walk.h.
struct CurvedStep {
  /// Share of the last free fraction for the next trial: each fraction has another chord.
  double shorter = 0.9;
  /// Share of the first free fraction for the first trial: distant bends make no difference.
  double barely_shorter = 1.0 - 1e-9;
  /// Trial fractions before the direction counts as blocked.
  int trials = 60;
};
inline constexpr CurvedStep kCurvedStep;

/// Bounds on the steps of links and joints: coordinates.cpp.
struct JointSteps {
  /// Largest turn of a link in a step [rad], beyond which the quadratic model of its points is void.
  double largest_turn = std::numbers::pi / 4.0;
  /// Share of the distance to the end of a limit that a step may use, to stay inside.
  double share_of_limit = 0.9;
};
inline constexpr JointSteps kJointSteps;

/// Search directions: direction.cpp.
struct Directions {
  /// Ratio to the last step below which a chord step is taken: slower chords cost more than a factor.
  double chord_contraction = 0.1;
  /// Operations of a factorization, up to some 18 x 18 vertices, below which a new factor costs less than
  /// iterations with an old one.
  double cheap_factor = 3e7;
  /// Most conjugate gradient iterations with an old factor: a new factor would be cheaper.
  int iterations = 8;
  /// Relative residual at which these iterations end: Newton's method needs no higher accuracy.
  double forcing = 0.03;
  /// Relative residual at which the iterations end if a factor is expensive, as more iterations pay
  /// then.
  double forcing_of_expensive = 0.01;
  /// Operations per entry of a factor that cost as much time as one iteration.
  double operations_per_iteration = 80.0;
  /// Largest displacement in a full exact step near a solution, as a share of an edge.
  double near = 0.03;
  /// Share s of the projection in the blend (H + s P) / (1 + s) after an indefinite Hessian.
  double first_share = 1.0;
  /// Growth of s while the blend is indefinite.
  double failure_growth = 4.0;
  /// Factor on s after a step that gains as predicted.
  double decay = 0.25;
  /// Factor on s after a step that gains little.
  double growth = 2.0;
  /// Value of s below which the exact Hessian is tried again.
  double no_share = 0.05;
  /// Largest s that poor steps lead to: little of H is left in the blend.
  double full_share = 64.0;
  /// Value of s beyond which the blend equals the projection up to rounding, and the direction is given up.
  double largest_share = 1e8;
  /// Share of the predicted gain above which a first trial is good.
  double good_gain = 0.25;
  /// Share of the predicted gain below which the model is poor, as after a valley is crossed.
  double poor_gain = 0.1;
  /// Backtracks from which on the model is poor.
  int many_backtracks = 3;
  /// Share of the projection's curvature that the blend must keep along a far direction.
  double held = 0.5;
  /// Fraction of a damped step from which on lengthening it pays.
  double worth_growing = 1.5;
  /// Largest fraction to which a damped step is lengthened.
  double largest_growth = 4.0;
};
inline constexpr Directions kDirections;

/// Linear solves to rounding with a factor in single precision: linear_system.cpp.
struct Refinement {
  /// Relative residual at which a solve has reached rounding.
  double residual = 1e-12;
  /// Largest number of iterations to reach that residual; a good factor takes three.
  int iterations = 30;
};
inline constexpr Refinement kRefinement;

/// Conjugate gradients: linalg/conjugate_gradient.cpp.
struct ConjugateGradients {
  /// Contraction of the residual in an iteration that is seldom exceeded: a solve that would need faster
  /// contraction is given up.
  double fastest = 2.5;
};
inline constexpr ConjugateGradients kConjugateGradients;

/// Agreement of a factor in single precision with its matrix. The first iteration must contract the
/// residual to a tenth, as the step must be right to a tenth; the next ones must reach a residual that
/// excludes a negative direction.
inline constexpr linalg::Agreement kAgreement{
    .first_contraction = 0.1, .residual = 1e-4, .iterations = 6};

/// Motion of prescribed points to their ends: motion.cpp, step/schemes/motion.cpp.
struct PrescribedMotion {
  /// Iterations after which the progress of a motion is checked.
  int stuck_iterations = 20;
  /// Fraction of the motion below which the progress since the last check counts as stuck.
  double stuck_progress = 1e-3;
  /// Largest turn of a body in a portion of its motion [rad]: straight paths of its vertices would collapse it.
  double largest_turn = 10.0 * std::numbers::pi / 180.0;
};
inline constexpr PrescribedMotion kPrescribedMotion;

/// Descent from a saddle: saddle.cpp.
struct Saddle {
  /// First shift to make the Hessian definite, as a share of M/h^2.
  double first_shift = 0.1;
  /// Growth of the shift.
  double shift_growth = 4.0;
  /// Number of shifts, the last of them 4e11.
  int shifts = 22;
  /// Inverse iterations for the most negative direction.
  int inverse_iterations = 30;
  /// Displacement of the first trial, as a share of the mean edge.
  double first_move = 0.25;
  /// Halvings of that move.
  int backtracks = 40;
};
inline constexpr Saddle kSaddle;

/// Local/global iterations: projective/local_global.cpp, step/nodal/stage.cpp.
struct LocalGlobal {
  /// Iterations allowed for each Newton iteration: the ratio of their times.
  std::int64_t iterations_per_newton = 50;
  /// Share of the largest coordinate below which a step is lost in rounding.
  double resolution = kNewton.resolution;
  /// Relative change of the energy for which rounding may account; below it, the slope decides.
  double energy_noise = kLineSearch.energy_noise;
  /// Share of the slope that must vanish in that case.
  double wolfe_slope = kLineSearch.wolfe_slope;
  /// Iterations after which the scale of the energy is computed again.
  int energy_age = 50;
  /// Iterations without a smaller residual or a gain above noise, after which rounding is reached.
  int idle_iterations = 1000;
  /// Ratio to the smallest residual so far below which a residual has shrunk.
  double progress = 0.9;
  /// Halvings of a plain step that raises the energy.
  int halvings = 40;
  /// With contact at nodes, iterations without halving the residual after which it stalls: on the path
  /// down from a saddle the residual must grow, which these iterations do not allow.
  int stalled_iterations = 100;
};
inline constexpr LocalGlobal kLocalGlobal;

/// The law of friction at the nodes of a linearized step: projective/coupled_coulomb.cpp.
struct CoupledCoulomb {
  /// Directions among which the roots of a slip are bracketed.
  int directions = 32;
  /// Refinements of a bracket.
  int refinements = 60;
  /// Width of a bracket that rounding does not resolve [rad].
  double angle = 1e-15;
  /// Sweeps between two attempts of Newton's method.
  int sweeps_per_polish = 20;
  /// Newton steps in such an attempt.
  int newton_steps = 10;
  /// Ratio to the last residual above which the attempt ends.
  double newton_contraction = 0.5;
  /// Sweeps after which contacts take half the share of their step: full steps may cycle.
  int sweeps_per_share = 100;
  /// Smallest such share.
  double least_share = 0.125;
  /// Change of the impulses, relative to the largest, that is rounding.
  double rounding = 1e-14;
};
inline constexpr CoupledCoulomb kCoupledCoulomb;

/// Newton's method with friction at nodes: step/nodal.
struct Nodal {
  /// Relative residual of a Newton direction: a smaller one would not save steps.
  double direction_tolerance = 1e-4;
  /// Ratio of squared residuals below which a Newton step is accepted; otherwise an energy decides.
  double contraction = 0.25;
  /// Share of the tolerance below which a step is not taken, as in Newton.
  double settled = 0.1;
  /// Descent steps with the current cases of the law before the law is solved as a whole.
  int most_descents = 8;
  /// Halvings of a step with the current cases: solving the law is better than a short step.
  int few_halvings = 6;
  /// Halvings of a step along the solution of the law.
  int halvings = 20;
  /// Ratio to the longest step below which steps at an indefinite Hessian lead to a saddle.
  double shrunk = 1e-2;
  /// Displacement of the first trial away from a saddle, as a share of the mean edge.
  double first_move = 0.25;
  /// First share of the projection in the blend of an indefinite Hessian: see Directions.
  double least_blend = 0.1;
  /// Share beyond which the blend equals the projection up to rounding.
  double most_blend = 1e12;
  /// Products with the matrix in one GMRES solve.
  int most_products = 300;
  /// Relative tolerance of the law at linearized forces, which only yields a direction.
  double law_tolerance = 1e-4;
  /// Sweeps over the contacts in its solution.
  int most_sweeps = 500;
  /// Relative residual of a derivative.
  double derivative_tolerance = 1e-12;
  /// Relative residual that rounding may leave in a derivative on a badly conditioned mesh.
  double largest_derivative_error = 1e-8;
};
inline constexpr Nodal kNodal;

}  // namespace stopping
}  // namespace diffcloth::solver
