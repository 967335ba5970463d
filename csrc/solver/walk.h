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
  double tolerance;    ///< bound on |p|_inf / h, p the full Newton step [m/s]
  int max_iterations;  ///< limit for a step, over all its solves
  double max_seconds = std::numeric_limits<double>::infinity();  ///< limit for a step [s]
  /// If true, every solve ends with a factor of the Hessian at its end. Otherwise a Newton or chord step
  /// below the tolerance may end it as well.
  bool certify = true;
  /// Size above which a factor is dropped before the next one is computed [bytes].
  std::size_t large_factor = std::size_t{64} << 20;
  /// Operations per entry above which a factor is expensive compared with a solve, which is bounded by
  /// memory: a sheet of 150 x 150 vertices or more.
  double dear_factor = 800.0;
};

/// Outcomes of failed factorizations in single precision during a step.
struct SinglePrecision {
  bool was_right = false;  ///< doubles found a matrix indefinite as well
  bool was_wrong = false;  ///< doubles factored a matrix that single precision could not
};

/// State shared by the solves of one step.
struct Context {
  Checkpoint* checkpoint;
  Options options;
  linalg::CholeskyWorkspace* workspace;
  Stopwatch* watch;
  Counts* counts;
  SinglePrecision single = {};
  int iterations = 0;                                ///< total of all solves so far
  std::vector<std::vector<double>>* path = nullptr;  ///< accepted iterates; null: not recorded
};

/// A polyline of feasible iterates: the current iterate, its gradient, and the motions from it that are
/// free of collisions. Every segment is certified.
class Walk {
 public:
  /// @param x  in: a feasible start; out: the current iterate
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

  /// Compute contacts, among the watched pairs, and the gradient at the current iterate.
  void refresh() {
    const Stopwatch::Scope scope(*context.watch, Phase::kAssembly);
    f.stand_at(x_.data());
    f.gradient(x_.data(), g_);
  }

  /// Displacement of a change of all points [m].
  double displacement(const std::vector<double>& p) const { return f.coordinates->displacement(p); }

  /// Detect collisions on the straight motion to a point. Contact then watches at least the part free of
  /// collisions, whose fraction is returned.
  double watch(const std::vector<double>& to) {
    if (f.contact == nullptr) return 1.0;
    const Stopwatch::Scope scope(*context.watch, Phase::kDetection);
    return f.contact->watch_free(x_.data(), to.data());
  }

  /// Flags of the surfaces that may meet something on the straight motion to a point.
  std::vector<char> meeting(const std::vector<double>& to) {
    const Stopwatch::Scope scope(*context.watch, Phase::kDetection);
    return f.contact->meeting(x_.data(), to.data());
  }

  /// Find the fraction, at most alpha, of a change of all points for which the straight motion of every
  /// point to its end is free of collisions; contact watches this motion.
  ///
  /// @param to  out: the end
  /// @return the fraction, 0 if there is none
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

  /// Change of the objective from the current iterate to a point of the watched motion.
  double change(const std::vector<double>& to) const {
    const Stopwatch::Scope scope(*context.watch, Phase::kLineSearch);
    return f.energy_change(x_.data(), to.data());
  }

  /// Move to a point of the watched motion; the gradient there must still be refreshed.
  void go(const std::vector<double>& to) {
    x_ = to;
    record();
    forget_energy();
  }

  /// Likewise, with a known change of the objective.
  void go(const std::vector<double>& to, double change) {
    const double before = extent_;
    go(to);
    extent_ = before + std::abs(change);
  }

  /// The objective at the current iterate.
  double energy() {
    if (!energy_) {
      energy_ = f.energy(x_.data());
      extent_ = std::abs(*energy_);
    }
    return *energy_;
  }

  /// Size of the objective at its last evaluation, plus all changes since, without the work of friction,
  /// which energies leave out. Infinity if unknown.
  double extent() const { return extent_; }

  /// An iterate to which the walk may return.
  struct Place {
    std::vector<double> x;
    std::size_t steps;  ///< length of the recorded path
  };
  Place place() const {
    return {.x = x_, .steps = context.path == nullptr ? 0 : context.path->size()};
  }

  /// Restore an iterate; all later steps are undone.
  void back(const Place& place) {
    x_ = place.x;
    forget_energy();
    if (context.path != nullptr) context.path->resize(place.steps);
    watch(x_);
    refresh();
  }

  /// Move to a point of the watched motion, with stresses extrapolated from the current iterate.
  void go_extrapolating(const std::vector<double>& to) {
    f.for_each([&](Potential& p) { p.extrapolate(x_.data(), to.data()); });
    go(to);
    refresh();
  }

  /// Move to a point of the watched motion unless the slope along p there exceeds a bound.
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

  /// Consume one iteration of the step's budget. False if iterations or time are used up.
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
