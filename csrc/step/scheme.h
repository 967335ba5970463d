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
  double* bodies;   ///< of contact, on the bodies' vertices [V, 3]
  double* contact;  ///< of contact, on the cloths' vertices [N, 3]
  double* pins;     ///< that hold the pinned vertices where they are [P, 3]
};

/// Forces that hold pins: the gradient of all that acts on them.
void add_pin_forces(const Problem& problem,
                    const solver::Objective& objective,
                    const std::vector<double>& x,
                    double* pins);

/// Context of a step that is to be taken.
struct Forward {
  Problem& problem;
  contact::Detection& detection;
  solver::Context& context;
  const Arrays<double>& tape;  ///< empty where no tape is wanted
  solver::KeptSolves& kept;    ///< for backward
  Report& report;
};

/// A step that has been taken, to be differentiated.
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
  bool barrier;   ///< whether gradients of the barrier's inputs are requested
  bool friction;  ///< likewise of friction, which depends on the barrier
};

/// A forward pass of tangents along several directions of the inputs side by side.
struct Pushforward : Taken {
  std::span<const Tangents> directions;
  std::span<const Forces> forces;  ///< of each direction: the changes of the forces are added here
};

/// A way to take a step: its minimizations, their order, and their derivatives.
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

  /// Pull the cotangents of the end back to all quantities that the potentials depend on, for each loss as if
  /// it were alone.
  virtual void backward(const Backward& step) const = 0;

  /// How all points at the end change along each direction, as if it were alone.
  virtual std::vector<std::vector<double>> tangent(const Pushforward& step) const = 0;
};

}  // namespace diffcloth::step
