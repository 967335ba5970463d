#include <algorithm>
#include <cmath>
#include <utility>

#include "solver/linear_system.h"
#include "step/nodal_stage.h"
#include "step/nodal_system.h"

namespace diffcloth::step {

using Array = std::vector<double>;

namespace {

/// Of a direction of Newton's method: less would not shorten the way.
constexpr double kDirectionTolerance = 1e-4;
/// A Newton step must reduce the squared residual by this much; else the energy leads.
constexpr double kContraction = 0.25;
/// As in solver/newton.cpp: a step below this share of the tolerance is not worth taking.
constexpr double kSettled = 0.1;
constexpr int kHalvings = 40;
/// Steps down the energy after which Newton's step is taken whatever it does to the residual: the
/// friction that they freeze may go round in circles.
constexpr int kMostDescents = 3;
/// Newton steps that are taken where no way leads down.
constexpr int kMostIdle = 20;
/// Of the exact Hessian's projection, where that is indefinite: see solver/direction.h.
constexpr double kLeastBlend = 0.1;
constexpr double kMostBlend = 1e12;

double largest(const Array& change) {
  double size = 0.0;
  for (const double value : change) {
    if (!std::isfinite(value)) return std::numeric_limits<double>::infinity();
    size = std::max(size, std::abs(value));
  }
  return size;
}

}  // namespace

solver::Outcome NodalStage::solve(solver::Context& context, Array& x) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  solver::LinearSystem linear(f, *context.workspace, *context.watch, *context.counts);
  const double goal = context.options.tolerance * problem_.h;
  solver::Outcome outcome;
  NodalSystem::Point here;
  NodalSystem::Point there;
  here.x = x;
  system.look(here);
  double blend = 0.0;
  int idle = 0;
  const auto finish = [&](solver::Status status) {
    outcome.status = status;
    x = std::move(here.x);
    return outcome;
  };
  // Where `there` is, by the fraction alpha of a change of the rows.
  const auto go = [&](const Array& p, double alpha) {
    there.x = here.x;
    for (std::size_t a = 0; a < problem_.cloth_size; ++a) there.x[a] += alpha * p[a];
  };
  int descents = 0;  // since Newton's method last had its way
  for (;; ++context.iterations) {
    context.checkpoint->check();
    const linalg::BlockMatrix H = linear.assemble(here.x.data(), Curvature::kExact, here.g);
    solver::Factor factor = linear.factor(system.without_coupling(here, H));
    const Array d = system.constraint_step(here);
    Array p;
    bool solved = false;
    if (factor) {
      const Stopwatch::Scope scope(*context.watch, Phase::kSolve);
      Array b = system.right_side(here, H, d, false);
      system.project(here, b);
      solved = system.solve(here, H, *factor, false, b, kDirectionTolerance, p).converged;
      for (std::size_t a = 0; a < p.size(); ++a) p[a] += d[a];
      const double step = largest(p);
      outcome.residual = step / problem_.h;
      if (solved && step <= kSettled * goal) {
        outcome.factor = factor;
        return finish(solver::Status::kConverged);
      }
      if (solved) {
        go(p, 1.0);
        system.look(there);
        const bool contracts = there.merit <= kContraction * here.merit;
        if (!contracts && step < goal) {  // what is left of the residual is rounding
          outcome.factor = factor;
          return finish(solver::Status::kConverged);
        }
        if (context.iterations >= context.options.max_iterations) {
          return finish(solver::Status::kIterationLimit);
        }
        if (contracts || (descents >= kMostDescents && std::isfinite(there.merit))) {
          descents = 0;
          ++context.counts->exact;
          std::swap(here, there);
          continue;
        }
      }
    } else {
      ++context.counts->negative_curvature;
    }
    if (context.iterations >= context.options.max_iterations) {
      return finish(solver::Status::kIterationLimit);
    }

    // With its friction frozen the step minimizes an energy: go down that one.
    blend = factor ? 0.0 : std::max(kLeastBlend, blend / 4.0);
    if (factor) {
      ++context.counts->exact;
    } else {
      ++context.counts->projected;
      const linalg::BlockMatrix positive =
          linear.assemble(here.x.data(), Curvature::kPositive, here.g);
      for (;; blend *= 4.0) {
        if (!(blend < kMostBlend)) return finish(solver::Status::kRoundingFloor);
        linalg::BlockMatrix damped = H;
        damped.blend(positive, blend);
        factor = linear.factor(system.without_coupling(here, damped));
        if (factor) break;
      }
    }
    const Stopwatch::Scope scope(*context.watch, Phase::kLineSearch);
    Array b = system.right_side(here, H, d, true);
    system.project(here, b);
    Array down(b.size(), 0.0);
    factor->solve(b.data(), down.data());
    for (std::size_t a = 0; a < down.size(); ++a) down[a] += d[a];
    bool moved = false;
    double alpha = 1.0;
    for (int k = 0; k < kHalvings && !moved; ++k, alpha *= 0.5) {
      go(down, alpha);
      system.clear_approach(there.x);
      moved = system.frozen_energy_change(here, there.x) < 0.0;
    }
    ++descents;
    if (!moved) {
      // The cases of the law at hand point nowhere: those behind Newton's step may.
      if (!solved || idle >= kMostIdle) return finish(solver::Status::kRoundingFloor);
      ++idle;
      go(p, 1.0);
    }
    system.look(there);
    std::swap(here, there);
  }
}

}  // namespace diffcloth::step
