#include "step/schemes/elastic_stage.h"

#include <algorithm>
#include <utility>

#include "projective/local_global.h"
#include "solver/newton.h"
#include "solver/stopping.h"
#include "step/potentials/constant_form.h"
#include "step/schemes/contact_stage.h"

namespace diffcloth::step {
namespace {

solver::Objective objective(Problem& problem) {
  return problem.objective(problem.inertia, problem.cloth_potentials(),
                           problem.scene.elastic_patterns);
}

void solve_by_newton(Problem& problem,
                     const Forward& step,
                     const NodalStage& nodes,
                     std::vector<double>& x) {
  // The iterates of this stage are no motion of the cloth.
  auto* const path = std::exchange(step.context.path, nullptr);
  const solver::Outcome outcome =
      nodes.has_contacts()
          ? nodes.solve(step.context, x)
          : solver::minimize(objective(problem), x, nullptr, nullptr, step.context);
  step.context.path = path;
  merge(outcome, step.report);
  step.kept.add(outcome.certificate);
}

/// Solve by local/global iterations. They yield no factor, so backward computes one. If they give up,
/// Newton's method solves from the same start.
void solve_by_projective_dynamics(Problem& problem,
                                  const Forward& step,
                                  const NodalStage& nodes,
                                  std::vector<double>& x) {
  const solver::Options& given = step.context.options;
  const projective::LocalGlobalOptions options{
      .tolerance = given.tolerance,
      .max_iterations =
          solver::stopping::kLocalGlobal.iterations_per_newton * given.max_iterations};
  Checkpoint& checkpoint = *step.context.checkpoint;
  const std::vector<double> start = x;
  projective::LocalGlobalOutcome outcome;
  {
    const Stopwatch::Scope scope(*step.context.watch, Phase::kSolve);
    const auto matrix = constant_matrix(problem);
    projective::LocalGlobalObjective f{.potentials = {&problem.inertia},
                                       .matrix = matrix.get(),
                                       .masses = &problem.masses,
                                       .h = problem.h};
    for (const Potential* p : problem.cloth_potentials()) f.potentials.push_back(p);
    outcome = nodes.has_contacts() ? nodes.iterate(f, options, checkpoint, x)
                                   : projective::minimize(f, x, options, checkpoint);
  }
  step.report.counts.local_global += outcome.iterations;
  const bool is_late = outcome.status == projective::LocalGlobalStatus::kTimeLimit;
  if (is_late) checkpoint.stop_clock();
  if (outcome.status != projective::LocalGlobalStatus::kConverged) {
    ++step.report.counts.left_to_newton;
    if (!is_late) x = start;  // else only the residual of the last iterate is computed
    solve_by_newton(problem, step, nodes, x);
    return;
  }
  solver::Outcome solved;
  solved.criterion = solver::Criterion::kTolerance;
  solved.residual = outcome.residual;
  merge(solved, step.report);
  step.kept.add({});
}

}  // namespace

std::vector<double> ElasticStage::forward(const Forward& step, const Forces& forces) const {
  // Pins and bodies are at their targets.
  std::vector<double> x = problem_.predicted(problem_.inertia.target().data());
  if (nodes_.has_contacts()) nodes_.start(x);
  if (problem_.scene.given.elastic == ElasticSolver::kProjective) {
    solve_by_projective_dynamics(problem_, step, nodes_, x);
  } else {
    solve_by_newton(problem_, step, nodes_, x);
  }
  if (nodes_.has_contacts()) {
    nodes_.finish(x, step.report, forces);
  } else if (!problem_.scene.given.pins.empty()) {
    const solver::Objective f = objective(problem_);
    f.stand_at(x.data());
    add_pin_forces(problem_, f, x, forces.pins);
  }
  if (!step.tape.empty()) std::copy_n(x.begin(), problem_.cloth_size, step.tape["elastic"]);
  return x;
}

void ElasticStage::backward(const Backward& step, const std::vector<std::vector<double>>& g) const {
  const std::vector<double> x = problem_.predicted(step.tape["elastic"]);
  const solver::Certificate certificate = step.kept.certificate(0);
  const Turn::Exchange exchange = [&](std::size_t l) { step.losses[l].exchange(problem_); };
  if (nodes_.has_contacts()) {
    for (std::size_t l = 0; l < g.size(); ++l) {
      const Turn turn(exchange, l);
      nodes_.backward(step, x, certificate.factor, g[l], step.losses[l]);
    }
    return;
  }
  const solver::Objective f = objective(problem_);
  f.stand_at(x.data());
  pull_back_solve(step, f, x, certificate, g, true, {}, exchange);
}

std::vector<std::vector<double>> ElasticStage::tangent(const Pushforward& step) const {
  const std::vector<double> x = problem_.predicted(step.tape["elastic"]);
  const solver::Certificate certificate = step.kept.certificate(0);
  const SetTangents set_tangents = [&](std::size_t l) {
    step.directions[l].push_forward(problem_);
  };
  if (nodes_.has_contacts()) {
    std::vector<std::vector<double>> dx;
    for (std::size_t l = 0; l < step.directions.size(); ++l) {
      set_tangents(l);
      dx.push_back(nodes_.tangent(step, x, certificate.factor, l));
    }
    return dx;
  }
  const solver::Objective f = objective(problem_);
  f.stand_at(x.data());
  return push_forward_solve(step, f, x, certificate, true, {}, set_tangents);
}

}  // namespace diffcloth::step
