#pragma once

#include <span>
#include <vector>

#include "solver/factor_cache.h"
#include "step/cotangents.h"
#include "step/inputs.h"
#include "step/problem.h"
#include "step/report.h"
#include "step/tangents.h"

namespace diffcloth::step {

/// Arrays to which the stages of a step add the forces at its end [N].
struct Forces {
  double* bodies;   ///< contact forces on the bodies' vertices [V, 3]
  double* contact;  ///< contact forces on the cloths' vertices [N, 3]
  double* pins;     ///< forces that hold the pinned vertices [P, 3]
};

/// Add the forces that hold pins: the gradient of the objective at them.
void add_pin_forces(const Problem& problem,
                    const solver::Objective& objective,
                    const std::vector<double>& x,
                    double* pins);

/// Context of a forward step.
struct Forward {
  Problem& problem;
  contact::Detection& detection;
  solver::Context& context;
  const Arrays<double>& tape;  ///< empty: no tape
  solver::KeptSolves& kept;    ///< solves kept for backward
  Report& report;
};

/// A completed step, to be differentiated.
struct Taken {
  Problem& problem;
  contact::Detection& detection;
  solver::Context& context;
  const Arrays<const double>& tape;
  const solver::KeptSolves& kept;  ///< empty if evicted
};

/// A reverse pass over several losses side by side.
struct Backward : Taken {
  std::span<Cotangents> losses;
  bool barrier;   ///< true if gradients of the barrier's inputs are requested
  bool friction;  ///< likewise for friction, which depends on the barrier
};

/// A forward pass of tangents along several directions of the inputs side by side.
struct Pushforward : Taken {
  std::span<const Tangents> directions;
  std::span<const Forces> forces;  ///< changes of the forces for each direction are added here
};

/// A scheme for a step: its minimizations, their order, and their derivatives.
class Scheme {
 public:
  Scheme() = default;
  virtual ~Scheme() = default;
  Scheme(const Scheme&) = delete;
  Scheme& operator=(const Scheme&) = delete;

  /// Fields that backward needs beyond the inputs: positions, no contacts and no matrices.
  virtual std::vector<Field> tape(const Scene& scene) const = 0;

  /// Find all points at the end of the step, and the forces there.
  ///
  /// @param x  in: at the start of the step
  virtual void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const = 0;

  /// Pull the cotangents of the end back to all quantities on which the potentials depend, separately
  /// for each loss.
  virtual void backward(const Backward& step) const = 0;

  /// Changes of all points at the end along each direction, separately for each.
  virtual std::vector<std::vector<double>> tangent(const Pushforward& step) const = 0;
};

}  // namespace diffcloth::step
