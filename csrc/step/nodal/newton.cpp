// Newton's method for a stage with dry friction at nodes.
//
// Newton's method on the equations of nodal/system.cpp converges fast once the case of each contact is
// known. Between cases, however, its residual is no merit function: steps that reduce the residual, and
// steps that do not, may cycle. A Newton step is therefore accepted only if it contracts the residual
// below all previous ones; otherwise an energy decides. With friction bounded by given impulses, the
// step minimizes
//
//   E_r(x) = energy + sum mu r_n |u_T|     over  n . u >= 0,
//
// and its solutions are the x that minimize E_r for their own impulses r. Two kinds of steps descend:
//
//   * Newton's step on E_r with the current impulses and cases, at the cost of one of the Newton steps
//     above;
//   * after some of these, or if they fail, the solution of the whole law at the linearized forces. This
//     solution decides on all cases at once and minimizes E_r to second order for its own r, so that it
//     is a descent direction unless it is zero.
//
// If the Hessian is indefinite, such steps would crawl past a saddle of E_r, or end there: once they
// shrink, the solver leaves along the direction of most negative curvature.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "solver/linear_system.h"
#include "solver/saddle.h"
#include "solver/stopping.h"
#include "step/nodal/stage.h"
#include "step/nodal/system.h"

namespace diffcloth::step {

using solver::stopping::kNodal;

using Array = std::vector<double>;

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

double largest(const Array& change) {
  double size = 0.0;
  for (const double value : change) {
    if (!std::isfinite(value)) return kInfinity;
    size = std::max(size, std::abs(value));
  }
  return size;
}

/// One solve: its current point and its kinds of steps.
class NodalSolve {
 public:
  NodalSolve(const Problem& problem,
             const NodalContacts& contacts,
             const solver::Objective& f,
             solver::Context& context,
             Array& x)
      : f_(f),
        context_(context),
        system_(problem, contacts, f),
        linear_(f, *context.workspace, *context.watch, *context.counts),
        h_(problem.h),
        goal_(context.options.tolerance * problem.h),
        x_(x) {
    here_.x = x;
    system_.look(here_);
  }

  solver::Outcome run() {
    try {
      return descend();
    } catch (const TimeIsUp&) {
      context_.checkpoint->stop_clock();
      return finish(solver::Criterion::kTimeLimit);
    }
  }

 private:
  enum class Newton : std::uint8_t { kNoStep, kContracts, kArrived };

  solver::Outcome descend() {
    outcome_.residual = kInfinity;  // until the first Newton step
    for (;; ++context_.iterations) {
      context_.checkpoint->check();
      assemble();
      S_ = std::make_unique<const linalg::BlockMatrix>(system_.without_coupling(here_, *H_));
      factor_ = linear_.factor_in_doubles(*S_);
      if (!factor_) ++context_.counts->negative_curvature;
      constraint_step_ = system_.constraint_step(here_);
      const Newton newton = factor_ ? try_newton() : Newton::kNoStep;
      if (newton == Newton::kArrived) return finish(outcome_.criterion);
      if (context_.checkpoint->is_up()) return finish(solver::Criterion::kTimeLimit);
      if (context_.iterations >= context_.options.max_iterations) {
        return finish(solver::Criterion::kIterationLimit);
      }
      if (newton != Newton::kContracts) {
        const Stopwatch::Scope scope(*context_.watch, Phase::kLineSearch);
        const bool moved =
            (is_near_saddle() && leave_saddle()) || descend_by_cases() || descend_by_law();
        if (!moved) return finish(solver::Criterion::kNoSolution);
        system_.look(there_);
      }
      ++(factor_ ? context_.counts->exact : context_.counts->projected);
      std::swap(here_, there_);
    }
  }

  solver::Outcome finish(solver::Criterion criterion) {
    outcome_.criterion = criterion;
    if (solver::has_converged(criterion)) outcome_.certificate.factor = factor_;
    outcome_.certified = outcome_.certificate.factor != nullptr;
    x_ = std::move(here_.x);
    return outcome_;
  }

  void assemble() {
    H_ = std::make_unique<const linalg::BlockMatrix>(
        linear_.assemble(here_.x.data(), Curvature::kExact, here_.g));
  }

  /// Set `there` to a fraction of a change of the rows.
  void go(const Array& p, double alpha) {
    there_.x = here_.x;
    const std::size_t size = std::min(p.size(), there_.x.size());
    for (std::size_t a = 0; a < size; ++a) there_.x[a] += alpha * p[a];
  }

  /// Store the length of a step.
  void measure(double step) {
    last_ = step;
    longest_ = std::max(longest_, step);
  }

  Newton arrive(solver::Criterion criterion) {
    outcome_.criterion = criterion;
    return Newton::kArrived;
  }

  /// Newton's step from here to there.
  Newton try_newton() {
    const Stopwatch::Scope scope(*context_.watch, Phase::kSolve);
    blend_ = 0.0;
    least_ = std::min(least_, here_.merit);
    Array b = system_.right_side(here_, *H_, constraint_step_, false);
    system_.project(here_, b);
    Array p;
    if (!system_.solve(here_, *H_, *factor_, false, b, kNodal.direction_tolerance, p).converged) {
      return Newton::kNoStep;
    }
    for (std::size_t a = 0; a < p.size(); ++a) p[a] += constraint_step_[a];
    const double step = largest(p);
    outcome_.residual = step / h_;
    if (step <= kNodal.settled * goal_) {
      return arrive(solver::Criterion::kTolerance);
    }
    go(p, 1.0);
    system_.look(there_);
    if (there_.merit <= kNodal.contraction * least_) {
      measure(step);
      descents_ = 0;
      return Newton::kContracts;
    }
    // Below the tolerance, the remaining residual is rounding.
    return step < goal_ ? arrive(solver::Criterion::kRounding) : Newton::kNoStep;
  }

  /// Factor of the form(Hessian), with the smallest blend of the projected Hessian that makes it
  /// positive definite; null if none does.
  template <class Form>
  solver::Factor damped(Form&& form) {
    const linalg::BlockMatrix positive =
        linear_.assemble(here_.x.data(), Curvature::kPositive, here_.g);
    for (blend_ = std::max(kNodal.least_blend, blend_ / 4.0); blend_ < kNodal.most_blend;
         blend_ *= 4.0) {
      linalg::BlockMatrix matrix = *H_;
      matrix.blend(positive, blend_);
      if (solver::Factor factor = linear_.factor_in_doubles(form(matrix))) return factor;
    }
    return nullptr;
  }

  /// Change of the energy with friction as large as the impulses allow, from here to a fraction of p.
  double change(const Array& p, double alpha, const std::vector<Vec3>& impulses) {
    go(p, alpha);
    system_.clear_approach(there_.x);
    return system_.frozen_energy_change(here_, impulses, there_.x);
  }

  bool descend(const Array& p, const std::vector<Vec3>& impulses, int halvings) {
    double alpha = 1.0;
    for (int k = 0; k < halvings; ++k, alpha *= 0.5) {
      if (!(change(p, alpha, impulses) < 0.0)) continue;
      measure(largest(p));
      return true;
    }
    return false;
  }

  std::vector<Vec3> impulses() const {
    std::vector<Vec3> result;
    result.reserve(here_.laws.size());
    for (const projective::Coulomb& law : here_.laws) result.push_back(law.impulse);
    return result;
  }

  bool descend_by_cases() {
    if (descents_ == kNodal.most_descents) return false;
    ++descents_;
    solver::Factor factor = factor_;
    if (!factor) {
      factor = damped([&](const linalg::BlockMatrix& matrix) {
        return system_.without_coupling(here_, matrix);
      });
    }
    if (!factor) return false;
    Array b = system_.right_side(here_, *H_, constraint_step_, true);
    system_.project(here_, b);
    Array p(b.size(), 0.0);
    factor->solve(b.data(), p.data());
    for (std::size_t a = 0; a < p.size(); ++a) p[a] += constraint_step_[a];
    if (descend(p, impulses(), kNodal.few_halvings)) return true;
    descents_ = kNodal.most_descents;
    return false;
  }

  bool descend_by_law() {
    if (system_.clear_approach(here_.x)) {
      system_.look(here_);
      assemble();
    }
    solver::Factor factor = linear_.factor_in_doubles(*H_);
    if (!factor) factor = damped([](const linalg::BlockMatrix& matrix) { return matrix; });
    if (!factor) return false;
    const NodalSystem::Linearized solution = system_.solve_linearized(here_, *factor);
    return descend(solution.p, solution.impulses, kNodal.halvings);
  }

  bool is_near_saddle() const { return !factor_ && last_ <= kNodal.shrunk * longest_; }

  /// Move along the direction of most negative curvature, on both sides, from far to near: to the first
  /// lower point, and further while the next is lower still.
  bool leave_saddle() {
    const Array p = solver::most_negative(f_, linear_, *context_.checkpoint, *S_);
    if (p.empty()) return false;
    const std::vector<Vec3> frozen = impulses();
    double best = 0.0;
    double best_alpha = 0.0;
    double alpha = kNodal.first_move * f_.length;
    for (int k = 0; k < 2 * kNodal.halvings; ++k, alpha *= k % 2 == 0 ? -0.5 : -1.0) {
      const double gained = change(p, alpha, frozen);
      if (gained < best) {
        best = gained;
        best_alpha = alpha;
      } else if (best < 0.0) {
        break;
      }
    }
    if (!(best < 0.0)) return false;
    change(p, best_alpha, frozen);
    // The history belongs to the saddle.
    last_ = least_ = kInfinity;
    longest_ = 0.0;
    descents_ = 0;
    return true;
  }

  const solver::Objective& f_;
  solver::Context& context_;
  NodalSystem system_;
  solver::LinearSystem linear_;
  double h_;
  double goal_;  // the tolerance of a step [m]
  Array& x_;
  solver::Outcome outcome_;

  NodalSystem::Point here_;
  NodalSystem::Point there_;
  std::unique_ptr<const linalg::BlockMatrix> H_;  // exact, at `here`
  std::unique_ptr<const linalg::BlockMatrix> S_;  // see nodal/system.cpp
  solver::Factor factor_;                         // factor of S; null if indefinite
  Array constraint_step_;

  double blend_ = 0.0;
  int descents_ = 0;          // descents by cases since the last successful Newton step
  double least_ = kInfinity;  // smallest residual with a definite S
  double last_ = kInfinity;   // length of the last step [m]
  double longest_ = 0.0;      // longest step so far [m]
};

}  // namespace

solver::Outcome NodalStage::solve(solver::Context& context, Array& x) const {
  const solver::Objective f = objective();
  return NodalSolve(problem_, contacts_, f, context, x).run();
}

}  // namespace diffcloth::step
