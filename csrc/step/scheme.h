#pragma once

#include <span>
#include <string_view>
#include <vector>

#include "step/cotangents.h"
#include "step/factor_cache.h"
#include "step/fields.h"
#include "step/forces.h"
#include "step/problem.h"
#include "step/report.h"
#include "step/tangents.h"

namespace diffcloth::step {

struct Scene;

/// What a scheme works with going forward.
struct Forward {
  Problem& problem;
  contact::Detection& detection;
  solver::Context& context;
  const Arrays<double>& tape;  ///< empty where no tape is wanted
  Kept& kept;                  ///< for backward
  Report& report;
};

/// A step that has been taken, to be differentiated.
struct Taken {
  Problem& problem;
  contact::Detection& detection;
  solver::Context& context;
  const Arrays<const double>& tape;
  const Kept& kept;  ///< empty where it is gone
};

/// What a scheme works with going back, for several losses side by side.
struct Backward : Taken {
  std::span<Cotangents> losses;
  bool barrier;   ///< whether someone asks for the cotangents of what the barrier is made of
  bool friction;  ///< the same of friction, which depends on the barrier
};

/// What it works with for tangents, along several directions of the inputs side by side.
struct Pushforward : Taken {
  std::span<const Tangents> directions;
  std::span<const Forces> forces;  ///< of each direction, where the changes of the forces are added
};

/// A way to take a step: what is minimized, in which order, and the derivatives of that.
class Scheme {
 public:
  Scheme() = default;
  virtual ~Scheme() = default;
  Scheme(const Scheme&) = delete;
  Scheme& operator=(const Scheme&) = delete;

  virtual std::string_view name() const = 0;

  /// Whether a barrier keeps surfaces apart; else cloths touch all bodies and each other at their nodes.
  virtual bool has_barrier() const { return true; }

  /// Whether cloths and dynamic bodies are solved for together.
  virtual bool moves_bodies() const { return false; }

  /// Whether elasticity is solved for on its own first, by one of kElasticSolvers.
  virtual bool has_elastic_stage() const { return false; }

  /// Whether it can measure nearness in each of kMetrics.
  virtual bool has_metrics() const { return false; }

  /// What backward needs of forward beyond the inputs: positions, no contacts and no matrices.
  virtual std::vector<Field> tape(const Scene& scene) const = 0;

  /// Find all points at the end of the step, and the forces there.
  ///
  /// @param x  in: at the start of the step
  virtual void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const = 0;

  /// From the cotangents of the end to those of all that the potentials depend on, for each loss as if
  /// it were alone.
  virtual void backward(const Backward& step) const = 0;

  /// How all points at the end change along each direction, as if it were alone.
  virtual std::vector<std::vector<double>> tangent(const Pushforward& step) const = 0;
};

/// The scheme of a name.
/// @throws std::invalid_argument with the names that there are
const Scheme& find_scheme(std::string_view name);

/// All schemes, the default first.
std::span<const Scheme* const> schemes();

}  // namespace diffcloth::step
