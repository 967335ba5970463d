#include "solver/newton.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

#include "solver/direction.h"
#include "solver/saddle.h"
#include "solver/stopping.h"

namespace diffcloth::solver {

using stopping::kExcursions;
using stopping::kNewton;

namespace {

class Descent {
 public:
  Descent(Walk& walk, Factor nearby)
      : walk_(walk),
        directions_(walk, std::move(nearby)),
        goal_(walk.f.h * walk.context.options.tolerance) {}

  Criterion run();

  double residual() const { return residual_; }
  const Certificate& certificate() const { return directions_.certificate(); }
  bool is_certified() const { return !ends_uncertified_; }

 private:
  enum class Next : std::uint8_t { kGoOn, kStop };

  Criterion descend();
  Next proceed();
  Criterion without_step();
  Next settle();
  Criterion look();
  Next take(const Directions::Direction& direction);
  Next stop(Criterion criterion) {
    criterion_ = criterion;
    return Next::kStop;
  }
  Next escape();
  Next no_way(const Directions::Direction& direction, double step, SearchResult result);
  bool is_settled(double step, double share) const;
  bool may_end(const Directions::Direction& direction, double step) const;
  bool may_end_uncertified(const Directions::Direction& direction) const;
  bool is_lost(double step) const;
  bool idles(double step, const Search& search);
  Next go(const Directions::Direction& direction, bool is_last = false);
  Search walk_along(const Directions::Direction& direction);
  Search wander(const Trial& trial);
  bool is_near(const std::vector<double>& p) const;
  Next come_back();

  Walk& walk_;
  Directions directions_;
  double goal_;  ///< step below which the solve has converged [m]
  Criterion criterion_ = Criterion::kIterationLimit;
  double residual_ = 0.0;
  bool settling_ = false;  ///< the last step was below the goal
  bool ends_uncertified_ = false;
  double settled_step_ = std::numeric_limits<double>::infinity();
  double best_ = std::numeric_limits<double>::infinity();
  int idle_ = 0;

  /// Steps that may raise the objective if the last one ends below the start.
  ///
  /// Stiff cloth moves in a curved valley: a step along its tangent stretches the cloth, and a search
  /// with monotone decrease takes hundreds of short steps. The next Newton step, however, relaxes the
  /// stretch of the last one and continues along the valley, provided that its Hessian has the stresses
  /// of the linear model of that step, which stretches nothing, and not the spurious ones (Magisano,
  /// Leonetti, Garcea 2017: Newton's method with mixed integration points).
  struct Excursion {
    Walk::Place start;
    std::vector<double> p;  ///< the first direction
    Directions::Direction direction;
    double share = 0.0;    ///< share of the projection at the start
    double enough = 0.0;   ///< change to end with [J]
    double balance = 0.0;  ///< change so far [J]
    int steps = 0;
  };
  bool away_ = false;  ///< true on an excursion
  Excursion excursion_;
  int wait_ = kExcursions.patience;  ///< ordinary steps before the next excursion
  int next_wait_ = 1;                ///< ordinary steps after the next failed excursion
};

/// Leave a saddle, or end the solve there.
Descent::Next Descent::escape() {
  if (!leave_saddle(walk_)) return stop(Criterion::kSaddle);
  directions_.restart();
  best_ = settled_step_ = std::numeric_limits<double>::infinity();
  idle_ = 0;
  return Next::kGoOn;
}

/// Factor the exact Hessian where the gradient is practically zero: the solve has converged, or one more
/// step or a descent from a saddle follows.
Descent::Next Descent::settle() {
  settling_ = false;
  if (!directions_.certify()) return escape();
  return take({.kind = Kind::kFactored, .first = 1.0});
}

/// True if a step below the goal is not worth taking.
bool Descent::is_settled(double step, double share) const {
  return step <= share * goal_ &&
         walk_.f.force_change(walk_.x().data(), directions_.p().data()) <= kNewton.force_change;
}

/// True if the end of a step below the goal should be certified. A chord step is often shorter than the
/// Newton step that it approximates: if the remaining error is too large, an expensive factorization
/// would be repeated.
bool Descent::may_end(const Directions::Direction& direction, double step) const {
  const bool doubtful = direction.kind == Kind::kChord && step > kNewton.settled_factored * goal_;
  return !(doubtful && directions_.is_dear());
}

/// True if a step below the goal may end the solve without a certificate: a Newton or chord step of a
/// definite exact Hessian that turns no contact from sticking to slipping.
bool Descent::may_end_uncertified(const Directions::Direction& direction) const {
  if (walk_.context.options.certify || away_ || directions_.is_certified()) return false;
  const bool exact = direction.kind == Kind::kFactored || direction.kind == Kind::kIterated ||
                     direction.kind == Kind::kChord;
  return exact &&
         walk_.f.force_change(walk_.x().data(), directions_.p().data()) <= kNewton.force_change;
}

/// True if rounding of the coordinates hides a step.
bool Descent::is_lost(double step) const {
  return !(step > kNewton.resolution * walk_.f.coordinates->extent(walk_.x()));
}

/// True if steps no longer shrink while their gain drowns in rounding.
bool Descent::idles(double step, const Search& search) {
  if (step < kNewton.progress * best_ || search.measured) {
    idle_ = 0;
  } else {
    ++idle_;
  }
  best_ = std::min(best_, step);
  return idle_ >= kNewton.idle_steps;
}

/// Handle a direction without an acceptable step.
Descent::Next Descent::no_way(const Directions::Direction& direction,
                              double step,
                              SearchResult result) {
  const bool exact = direction.kind != Kind::kDamped;
  const Criterion without_gain = is_lost(step) ? Criterion::kPrecisionLimit : Criterion::kNoDescent;
  if (exact && result == SearchResult::kNoGain) {
    if (direction.kind == Kind::kFactored && (step >= goal_ || directions_.is_certified())) {
      return stop(step < goal_ ? Criterion::kRounding : without_gain);
    }
    if (step < goal_) {
      settling_ = true;
      return Next::kGoOn;
    }
  }
  if (directions_.retry(direction.kind)) return Next::kGoOn;
  return stop(result == SearchResult::kBlocked ? Criterion::kBlocked : without_gain);
}

/// True if a step of this length is allowed on an excursion.
bool Descent::is_near(const std::vector<double>& p) const {
  const Coordinates& coordinates = *walk_.f.coordinates;
  const double farthest = kExcursions.farthest * walk_.f.length;
  for (Index i = coordinates.cloth_vertex_count(); i < coordinates.vertex_count(); ++i) {
    if (!(row(p.data(), i).squaredNorm() < farthest * farthest)) return false;
  }
  return coordinates.cloth_vertex_count() > 0;
}

/// Search along the direction. If the full step would raise the objective, it may begin an excursion.
Search Descent::walk_along(const Directions::Direction& direction) {
  const std::vector<double>& p = directions_.p();
  Trial trial = farthest(walk_, p, direction.first);
  const double slope = dot(walk_.g(), p);
  const double enough = trial.enough(slope);
  const bool rises = slope < 0.0 && trial.alpha > kExcursions.free && std::isfinite(trial.gain) &&
                     trial.gain > enough;
  // The next step relaxes the stretch of this one, but cannot undo motion into barriers.
  const bool touches = walk_.f.contact != nullptr && !walk_.f.contact->contacts().empty();
  const bool far = !touches || walk_.displacement(p) > kExcursions.far * walk_.f.length;
  if (wait_ == 0 && direction.kind != Kind::kDamped && far && is_near(p) && rises &&
      trial.gain > 0.0 && !drowns(walk_, trial.gain)) {
    excursion_ = {.start = walk_.place(),
                  .p = p,
                  .direction = direction,
                  .share = directions_.share(),
                  .enough = enough};
    away_ = true;
    return wander(trial);
  }
  wait_ = std::max(wait_ - 1, 0);
  return search(walk_, p, std::move(trial));
}

/// One step of an excursion. The excursion ends if the step ends below its start; no step if it fails.
Search Descent::wander(const Trial& trial) {
  const double balance = excursion_.balance + trial.gain;
  const bool ends = trial.alpha > 0.0 && balance <= excursion_.enough;
  if (!is_near(directions_.p())) return {.result = SearchResult::kNoGain};
  if (!ends && !(trial.alpha > kExcursions.free && std::isfinite(balance) &&
                 excursion_.steps < kExcursions.steps)) {
    return {.result = SearchResult::kNoGain};
  }
  walk_.go_extrapolating(trial.to);
  excursion_.balance = balance;
  ++excursion_.steps;
  if (ends) {
    away_ = false;
    next_wait_ = 1;
  }
  return {.result = SearchResult::kMoved, .alpha = trial.alpha, .gain = trial.gain};
}

/// Undo an excursion, and continue from its start with ordinary steps.
Descent::Next Descent::come_back() {
  away_ = false;
  wait_ = next_wait_;
  next_wait_ = std::min(2 * next_wait_, kExcursions.longest_wait);
  walk_.back(excursion_.start);
  directions_.resume(excursion_.p, excursion_.share);
  return go(excursion_.direction);
}

Descent::Next Descent::take(const Directions::Direction& direction) {
  double step = walk_.displacement(directions_.p());
  if (step < goal_ && may_end_uncertified(direction)) {
    residual_ = step / walk_.f.h;
    if (step > kNewton.settled * goal_ && !is_lost(step)) return go(direction, true);
    ends_uncertified_ = true;
    return stop(Criterion::kTolerance);
  }
  if (direction.kind == Kind::kFactored && step < goal_ && !directions_.is_certified()) {
    residual_ = step / walk_.f.h;
    if (!directions_.confirm()) return escape();
    step = walk_.displacement(directions_.p());  // possibly by a factor in double precision
  }
  const bool lost = is_lost(step);
  // An excursion must not end in a minimum above its start.
  if (away_ && (step < goal_ || lost)) return come_back();
  residual_ = step / walk_.f.h;
  if (direction.kind == Kind::kDamped) {
    if (step < kNewton.settled * goal_) {
      settling_ = true;
      return Next::kGoOn;
    }
  } else if (step < goal_) {
    if (direction.kind != Kind::kFactored) {
      settling_ = may_end(direction, step);
      if (is_settled(step, kNewton.settled)) return Next::kGoOn;
    } else if (is_settled(step, kNewton.settled_factored)) {
      return stop(Criterion::kTolerance);
    } else if (step > kNewton.contraction * settled_step_) {
      return stop(Criterion::kRounding);
    } else {
      settled_step_ = step;
    }
  }
  if (lost) return no_way(direction, step, SearchResult::kNoGain);
  return go(direction);
}

/// Step along the direction, and update the direction's state from the search.
///
/// @param is_last  true if the solve ends, uncertified, after this step
Descent::Next Descent::go(const Directions::Direction& direction, bool is_last) {
  const double step = walk_.displacement(directions_.p());
  const Search search =
      away_ ? wander(farthest(walk_, directions_.p(), 1.0)) : walk_along(direction);
  if (search.result != SearchResult::kMoved && away_) return come_back();
  if (search.result != SearchResult::kMoved) {
    settling_ = false;
    return no_way(direction, step, search.result);
  }
  directions_.learn(direction, search);
  if (is_last) {
    ends_uncertified_ = true;
    return stop(Criterion::kTolerance);
  }
  if (direction.kind != Kind::kDamped && idles(step, search)) {
    if (step >= goal_) return stop(Criterion::kPrecisionLimit);
    settling_ = true;
  }
  return Next::kGoOn;
}

/// The criterion if no Newton step can be computed.
Criterion Descent::without_step() {
  residual_ = std::numeric_limits<double>::infinity();
  const bool finite = std::ranges::all_of(walk_.g(), [](double g) { return std::isfinite(g); });
  return finite ? Criterion::kIndefinite : Criterion::kNotFinite;
}

/// Evaluate the final iterate when iterations or time are used up: residual and criterion of this point.
Criterion Descent::look() {
  if (away_) walk_.back(excursion_.start);
  const bool is_late = walk_.context.checkpoint->is_up();
  const bool minimum = directions_.certify();
  // Shifts of an indefinite Hessian need many factorizations, for which no time is left.
  const bool has_step =
      minimum || (is_late ? directions_.project() : directions_.next().has_value());
  if (!has_step) return without_step();
  const double step = walk_.displacement(directions_.p());
  residual_ = step / walk_.f.h;
  if (is_late && !minimum) return Criterion::kTimeLimit;
  if (step >= goal_) return is_late ? Criterion::kTimeLimit : Criterion::kIterationLimit;
  return minimum ? Criterion::kTolerance : Criterion::kSaddle;
}

Descent::Next Descent::proceed() {
  const std::optional<Directions::Direction> direction =
      away_ ? directions_.next_extrapolated() : directions_.next();
  if (direction) return take(*direction);
  return away_ ? come_back() : stop(without_step());
}

Criterion Descent::run() {
  try {
    return descend();
  } catch (const TimeIsUp&) {
    walk_.context.checkpoint->stop_clock();
    walk_.back(walk_.place());
    directions_.restart();
    return look();
  }
}

Criterion Descent::descend() {
  for (;;) {
    if (settling_) {
      walk_.context.checkpoint->check();
      if (settle() == Next::kStop) return criterion_;
      continue;
    }
    if (!walk_.spend()) return look();
    if (proceed() == Next::kStop) return criterion_;
  }
}

using FreeBodies = std::vector<const bodies::Mechanisms::FreeBody*>;

/// Remove the bodies that meet something on the straight motion from the current iterate.
void leave_out_meeting(Walk& walk, const std::vector<double>& to, FreeBodies& bodies) {
  if (walk.f.contact == nullptr || bodies.empty()) return;
  const std::vector<char> meets = walk.meeting(to);
  std::erase_if(bodies, [&](const auto* body) {
    return std::ranges::any_of(body->surfaces, [&](Index s) { return meets[s] != 0; });
  });
}

/// True if friction opposes the motion from the current iterate. An object in a grip, for example, must
/// not begin at its inertial guess outside the grip: the fingers would close behind it.
bool is_resisted(const Walk& walk, const std::vector<double>& to) {
  return walk.f.friction->energy_change(walk.x().data(), to.data()) > 0.0;
}

/// The current iterate, with the free bodies at their guess that reach it without contact or friction:
/// no potential but contact couples them to the rest, so the rest of the scene should not hold them
/// back.
std::vector<double> with_flown_bodies(Walk& walk, const std::vector<double>& guess) {
  const std::vector<double>& start = walk.x();
  const Coordinates& coordinates = *walk.f.coordinates;
  const auto numbers = [&](const bodies::Mechanisms::FreeBody& body) {
    const std::ptrdiff_t vertices = coordinates.vertex_count();
    return std::pair{3 * (vertices + body.first_node), 3 * (vertices + body.last_node)};
  };
  const auto with = [&](const FreeBodies& bodies) {
    std::vector<double> flown = start;
    for (const auto* body : bodies) {
      const auto [first, last] = numbers(*body);
      std::copy(guess.begin() + first, guess.begin() + last, flown.begin() + first);
    }
    coordinates.place(flown);
    return flown;
  };
  FreeBodies flying;
  std::vector<double> change(start.size(), 0.0);
  for (const bodies::Mechanisms::FreeBody& body : walk.f.free_bodies) {
    const auto [first, last] = numbers(body);
    for (std::ptrdiff_t a = first; a < last; ++a) change[a] = guess[a] - start[a];
    if (coordinates.largest_fraction(start, change) >= 1.0 &&
        (walk.f.friction == nullptr || !is_resisted(walk, with({&body}))))
      flying.push_back(&body);
    std::fill(change.begin() + first, change.begin() + last, 0.0);
  }
  leave_out_meeting(walk, guess, flying);
  while (!flying.empty()) {
    std::vector<double> flown = with(flying);
    // A body that stays behind may block another that would have followed it.
    const std::size_t before = flying.size();
    leave_out_meeting(walk, flown, flying);
    if (flying.size() == before) return flown;
  }
  return start;
}

/// Begin at the guess instead of x if it is better and the straight path to it free of contact;
/// otherwise move at least the free bodies that meet nothing.
bool start_from(Walk& walk, const std::vector<double>& guess) {
  const std::vector<double> flown = with_flown_bodies(walk, guess);
  // If inertia alone would collapse the cloth (long steps, forces on light vertices), the start of the
  // step with pins at their ends is the better initial iterate.
  std::vector<double> held = guess;
  const Coordinates& coordinates = *walk.f.coordinates;
  for (Index i = 0; i < coordinates.row_count(); ++i) {
    if (!coordinates.is_free(i)) continue;
    const Index point = coordinates.point(i);
    Eigen::Map<Vec3>(held.data() + 3 * point) = row(flown.data(), point);
  }
  coordinates.place(held);
  const auto is_better_and_free = [&] {
    // This form rejects a change of NaN, from strains that overflow.
    if (!(walk.f.energy_change_without_contact(held.data(), guess.data()) <= 0.0)) return false;
    if (walk.f.friction != nullptr && is_resisted(walk, guess)) return false;
    std::vector<double> change(guess.size());
    for (std::size_t a = 0; a < guess.size(); ++a) change[a] = guess[a] - walk.x()[a];
    if (coordinates.largest_fraction(walk.x(), change) < 1.0 || walk.watch(guess) < 1.0)
      return false;
    if (walk.f.contact == nullptr) return true;
    walk.f.contact->stand_at(guess.data());
    return walk.f.contact->contacts().empty();
  };
  const bool taken = is_better_and_free();
  if (taken || flown != walk.x()) walk.go(taken ? guess : flown);
  return taken;
}

/// The criterion that ended a prescribed motion early.
Criterion end_of_motion(const Context& context) {
  if (context.checkpoint->is_up()) return Criterion::kTimeLimit;
  const bool is_used_up = context.iterations >= context.options.max_iterations;
  return is_used_up ? Criterion::kIterationLimit : Criterion::kStuckMotion;
}

/// Compute the contacts of the current iterate, also when the time of the step is up.
void watch_here(Walk& walk) {
  try {
    walk.watch(walk.x());
  } catch (const TimeIsUp&) {
    walk.context.checkpoint->stop_clock();
    walk.watch(walk.x());
  }
}

}  // namespace

Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const Departure* departure,
                 Factor nearby,
                 Context& context) {
  Walk walk(objective, x, context);
  Outcome outcome;
  bool guessed = false;
  try {
    guessed = departure != nullptr && departure->guess != nullptr &&
              departure->motion.portions() == 1 && start_from(walk, *departure->guess);
  } catch (const TimeIsUp&) {
    context.checkpoint->stop_clock();
  }
  if (!guessed) watch_here(walk);
  walk.refresh();
  if (departure != nullptr && !guessed) {
    // A stiff drive at its limit balances within rounding: exact steps would alternate between two
    // points forever. The projected Hessian has more curvature, and its step ends between them.
    const bool descends = departure->guess != nullptr ||
                          (objective.chart != nullptr && objective.chart->has_joint_terms());
    outcome.motion_fraction = arrive(walk, departure->motion, descends);
    if (outcome.motion_fraction < 1.0) {
      outcome.criterion = end_of_motion(context);
      return outcome;
    }
  }
  Descent descent(walk, std::move(nearby));
  outcome.criterion = descent.run();
  outcome.residual = descent.residual();
  outcome.nearby = descent.certificate().factor;
  outcome.certified = has_converged(outcome.criterion) && descent.is_certified();
  if (outcome.certified) outcome.certificate = descent.certificate();
  return outcome;
}

}  // namespace diffcloth::solver
