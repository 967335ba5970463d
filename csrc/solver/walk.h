#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <vector>

#include "common/interrupt.h"
#include "common/stopwatch.h"
#include "solver/linear_system.h"
#include "solver/objective.h"
#include "solver/stopping.h"

namespace diffcloth::solver {

using linalg::dot;

struct Options {
  double tolerance;    ///< on |p|_inf / h, p the full Newton step [m/s]
  int max_iterations;  ///< of a step, over all its solves
  double max_seconds = std::numeric_limits<double>::infinity();  ///< of a step [s]
  /// Whether every solve ends with a factor of the Hessian at its end. Otherwise a Newton or chord step below
  /// the tolerance ends it, too.
  bool certify = true;
  /// A factor of more than this is dropped before the next one is made [bytes].
  std::size_t large_factor = std::size_t{64} << 20;
  /// A factor of more operations per entry, of a sheet of 150 x 150 vertices or more, is dear beside the
  /// solves with it, which are bounded by memory.
  double dear_factor = 800.0;
};

/// What a step has seen of factorizations in single precision that fail.
struct SinglePrecision {
  bool was_right = false;  ///< doubles have found a matrix indefinite, too
  bool was_wrong = false;  ///< doubles have factored one
};

/// What the solves of one step share.
struct Context {
  Checkpoint* checkpoint;
  Options options;
  linalg::CholeskyWorkspace* workspace;
  Stopwatch* watch;
  Counts* counts;
  SinglePrecision single = {};
  int iterations = 0;                                ///< taken by all solves so far
  std::vector<std::vector<double>>* path = nullptr;  ///< accepted iterates, where wanted
};

/// A walk from one feasible point to the next: the positions, the gradient there, and which motions
/// from there are free of collisions. Every segment walked is certified.
class Walk {
 public:
  /// @param x  in: a feasible start; moves along
  Walk(const Objective& f, std::vector<double>& x, Context& context)
      : f(f),
        context(context),
        system(f, *context.workspace, *context.watch, *context.counts),
        x_(x) {
    record();
  }

  const Objective& f;
  Context& context;
  LinearSystem system;

  const std::vector<double>& x() const { return x_; }
  const std::vector<double>& g() const { return g_; }

  /// Find contacts and gradient where the walk stands, among the watched pairs.
  void refresh() {
    const Stopwatch::Scope scope(*context.watch, Phase::kAssembly);
    f.stand_at(x_.data());
    f.gradient(x_.data(), g_);
  }

  /// Size of a change of all points [m].
  double displacement(const std::vector<double>& p) const { return f.coordinates->displacement(p); }

  /// Watch the straight motion to a point, at least as far as it is free of collisions; returns the fraction
  /// that is.
  double watch(const std::vector<double>& to) {
    if (f.contact == nullptr) return 1.0;
    const Stopwatch::Scope scope(*context.watch, Phase::kDetection);
    return f.contact->watch_free(x_.data(), to.data());
  }

  /// The surfaces that may meet something on the straight motion to a point.
  std::vector<char> meeting(const std::vector<double>& to) {
    const Stopwatch::Scope scope(*context.watch, Phase::kDetection);
    return f.contact->meeting(x_.data(), to.data());
  }

  /// Go along a change of all points, by the fraction alpha or less, as far as the straight motion of
  /// every point to where it ends is free of collisions; what is watched is that motion.
  ///
  /// @param to  out: the end
  /// @return the fraction, 0 where there is no way
  double watch(const std::vector<double>& p, double alpha, std::vector<double>& to) {
    f.coordinates->retract(x_, p, alpha, to);
    double safe = watch(to);
    if (!f.coordinates->is_curved(p)) {
      if (safe < 1.0) {
        alpha *= safe;
        f.coordinates->retract(x_, p, alpha, to);
      }
      return alpha;
    }
    for (int k = 0; safe < 1.0; ++k) {
      if (!(safe > 0.0) || k == stopping::kCurvedStep.trials) return 0.0;
      alpha *=
          (k == 0 ? stopping::kCurvedStep.barely_shorter : stopping::kCurvedStep.shorter) * safe;
      f.coordinates->retract(x_, p, alpha, to);
      safe = watch(to);
    }
    return alpha;
  }

  /// Change of the objective on the way to a point of the watched motion.
  double change(const std::vector<double>& to) const {
    const Stopwatch::Scope scope(*context.watch, Phase::kLineSearch);
    return f.energy_change(x_.data(), to.data());
  }

  /// Go to a point of the watched motion; the gradient there is still to be refreshed.
  void go(const std::vector<double>& to) {
    x_ = to;
    record();
    forget_energy();
  }

  /// The same where the change of the objective is known.
  void go(const std::vector<double>& to, double change) {
    const double before = extent_;
    go(to);
    extent_ = before + std::abs(change);
  }

  /// The objective where the walk stands.
  double energy() {
    if (!energy_) {
      energy_ = f.energy(x_.data());
      extent_ = std::abs(*energy_);
    }
    return *energy_;
  }

  /// The size of the objective when it was last asked for, and of all that it has changed by since: without
  /// the work of friction, which energies leave out. Infinity where that is not known.
  double extent() const { return extent_; }

  /// Where the walk stands, to come back to.
  struct Place {
    std::vector<double> x;
    std::size_t steps;  ///< on the recorded path
  };
  Place place() const {
    return {.x = x_, .steps = context.path == nullptr ? 0 : context.path->size()};
  }

  /// Be back at a place, as if nothing had been walked since.
  void back(const Place& place) {
    x_ = place.x;
    forget_energy();
    if (context.path != nullptr) context.path->resize(place.steps);
    watch(x_);
    refresh();
  }

  /// Go to a point of the watched motion, with stresses extrapolated from here.
  void go_extrapolating(const std::vector<double>& to) {
    f.for_each([&](Potential& p) { p.extrapolate(x_.data(), to.data()); });
    go(to);
    refresh();
  }

  /// Go to a point of the watched motion unless the slope along p there is above a bound.
  bool go_if_flat(const std::vector<double>& to, const std::vector<double>& p, double bound) {
    std::vector<double> x_before = to;
    x_before.swap(x_);
    std::vector<double> g_before = g_;
    refresh();
    if (dot(g_, p) <= bound) {
      record();
      forget_energy();
      return true;
    }
    x_.swap(x_before);
    g_.swap(g_before);
    f.stand_at(x_.data());
    return false;
  }

  /// Take one iteration from the budget of the step. False when it is used up, or the time.
  bool spend() {
    context.checkpoint->check();
    if (context.checkpoint->is_up()) return false;
    if (context.iterations >= context.options.max_iterations) return false;
    ++context.iterations;
    return true;
  }

 private:
  void forget_energy() {
    energy_.reset();
    extent_ = std::numeric_limits<double>::infinity();
  }
  void record() {
    if (context.path != nullptr) context.path->push_back(x_);
  }

  std::vector<double>& x_;
  std::vector<double> g_;
  std::optional<double> energy_;
  double extent_ = std::numeric_limits<double>::infinity();
};

}  // namespace diffcloth::solver
