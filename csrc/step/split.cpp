// The adjoint of `split` is that of its contact stage (contact_stage.cpp), whose target is x^D; the
// cotangent of x^D is the g of one more adjoint of the same form, that of the elastic stage: the
// paper's Eqs. 8 and 29 with all explicit terms.

#include "step/split.h"

#include <algorithm>
#include <optional>
#include <string_view>
#include <utility>

#include "elastic/elastic_nearness.h"
#include "elastic/repeated_elasticity.h"
#include "projective/local_global.h"
#include "solver/newton.h"
#include "step/contact_stage.h"
#include "step/motion.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Nearness to x^D, in the metric G of the contact stage.
///
/// `elastic` is G = h^2 A with A = M/h^2 + L the constant matrix of the whole elastic stage, soft pins
/// and damping included: what contact pushes then pulls along what it hangs on, as it would in one
/// solve with that matrix for a Hessian. L annihilates constants, so that a free cloth keeps its
/// momentum as it does in the masses alone.
class Nearness {
 public:
  Nearness(Problem& problem, const Array& x_d)
      : problem_(problem), inertial_(diagonal(problem), x_d, problem.h) {
    if (problem.scene.given.metric != Metric::kElastic) return;
    elastic_.emplace(problem.constant_form(), problem.elasticity,
                     problem.anchors ? &*problem.anchors : nullptr, x_d);
  }

  ContactStage stage() {
    const Scene& scene = problem_.scene;
    if (!elastic_) {
      return {.inertia = inertial_,
              .others = {},
              .assemblies = scene.diagonal_assemblies,
              .first_factor = 1};
    }
    return {.inertia = inertial_,
            .others = {&*elastic_},
            .assemblies = scene.elastic_assemblies,
            .first_factor = 1};
  }

  /// Cotangent of x^D.
  Array target_bar() const {
    Array bar = inertial_.target_bar;
    if (!elastic_) return bar;
    for (std::size_t a = 0; a < bar.size(); ++a) bar[a] += elastic_->target_bar[a];
    return bar;
  }

  /// Into the cotangents of the masses that G is made of.
  void add_masses_bar(Array& masses_bar) const {
    const Array& bar = inertial_.metric_bar;
    double mean = 0.0;
    for (const double value : bar) mean += value;
    mean /= static_cast<double>(bar.size());
    for (std::size_t i = 0; i < bar.size(); ++i) {
      masses_bar[i] += problem_.scene.given.metric == Metric::kIdentity ? mean : bar[i];
    }
  }

 private:
  /// G less h^2 L, which is diagonal [kg].
  static Array diagonal(const Problem& p) {
    if (p.scene.given.metric != Metric::kIdentity) return p.masses;
    // The literal metric weighs all vertices alike; the mean mass keeps the energy in joules.
    double mean = 0.0;
    for (const double m : p.masses) mean += m;
    mean /= static_cast<double>(p.masses.size());
    Array metric(p.masses.size(), mean);
    return metric;
  }

  Problem& problem_;
  Proximity inertial_;
  std::optional<elastic::ElasticNearness> elastic_;
};

std::string_view words(projective::Status status) {
  switch (status) {
    case projective::Status::kConverged:
      return {};
    case projective::Status::kIterationLimit:
      return "the local/global iterations of the step are used up";
    case projective::Status::kRoundingFloor:
      return "rounding hides any further decrease of the elastic stage";
    case projective::Status::kOverflow:
      return "the forces of the elastic stage are not finite";
  }
  __builtin_unreachable();
}

/// By local/global iterations. No factor comes out of them: backward makes it.
void solve_by_projective_dynamics(const Forward& step, Array& x) {
  Problem& problem = step.problem;
  const Stopwatch::Scope scope(*step.context.watch, Phase::kSolve);
  const auto matrix = problem.constant_matrix();
  const elastic::RepeatedElasticity elasticity(problem.model, problem.scene.slots,
                                               problem.scene.elastic_assemblies.base());
  projective::Objective f{.potentials = {&problem.inertia, &elasticity},
                          .matrix = matrix.get(),
                          .masses = &problem.masses,
                          .h = problem.h};
  if (problem.anchors) f.potentials.push_back(&*problem.anchors);
  const solver::Options& given = step.context.options;
  const projective::Outcome outcome = projective::minimize(
      f, x,
      {.tolerance = given.tolerance,
       .max_iterations = projective::kIterationsPerNewton * given.max_iterations},
      *step.context.checkpoint);
  step.report.counts.local_global += outcome.iterations;
  step.report.residual = std::max(step.report.residual, outcome.residual);
  if (outcome.status != projective::Status::kConverged) {
    step.report.result = Result::kNotConverged;
    step.report.message = words(outcome.status);
  }
  step.factors.push_back(nullptr);
}

void solve_by_newton(const Forward& step, Array& x) {
  Problem& problem = step.problem;
  const solver::Objective f = problem.objective(problem.inertia, problem.elastic_potentials(),
                                                problem.scene.elastic_assemblies);
  // Its way is no motion of the cloth.
  auto* const path = std::exchange(step.context.path, nullptr);
  const solver::Outcome outcome =
      solver::minimize(f, x, Motion(problem), nullptr, nullptr, step.context);
  step.context.path = path;
  merge(outcome, step.report);
  step.factors.push_back(outcome.factor);
}

/// x^D: pins are at their targets, and so are the bodies, which nothing here looks at.
Array solve_elastic_stage(const Forward& step) {
  Array x = step.problem.predicted(step.problem.inertia.target().data());
  if (step.problem.scene.given.elastic == ElasticSolver::kProjective) {
    solve_by_projective_dynamics(step, x);
  } else {
    solve_by_newton(step, x);
  }
  return x;
}

}  // namespace

std::vector<Field> Split::tape(const Scene& scene) const {
  std::vector<Field> fields = ContactStage::tape(scene);
  fields.push_back(
      {.name = "elastic", .shape = {static_cast<std::size_t>(scene.cloth_vertex_count()), 3}});
  return fields;
}

void Split::forward(const Forward& step, Array& x, double* body_forces) const {
  Problem& problem = step.problem;
  Array x_d = solve_elastic_stage(step);
  x_d.resize(problem.cloth_size);
  if (!step.tape.empty()) std::ranges::copy(x_d, step.tape["elastic"]);
  Nearness(problem, x_d).stage().forward(step, x, body_forces);
}

void Split::backward(const Backward& step) const {
  Problem& problem = step.problem;
  const double* x_d = step.tape["elastic"];
  Nearness nearness(problem, Array(x_d, x_d + problem.cloth_size));
  nearness.stage().backward(step, step.cotangents.rows);
  nearness.add_masses_bar(step.cotangents.masses);

  const solver::Objective f = problem.objective(problem.inertia, problem.elastic_potentials(),
                                                problem.scene.elastic_assemblies);
  Array g = nearness.target_bar();
  g.resize(problem.coordinates.size(), 0.0);
  const Array x = problem.predicted(x_d);
  problem.coordinates.stand_at(x.data());
  pull_back_solve(step, f, x, step.factors.empty() ? nullptr : step.factors.front(), g, nullptr);
}

}  // namespace diffcloth::step
