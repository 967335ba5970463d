#include "step/elastic_stage.h"

#include <algorithm>
#include <utility>

#include "solver/newton.h"
#include "step/contact_stage.h"
#include "step/motion.h"

namespace diffcloth::step {

using Array = std::vector<double>;

Array ElasticStage::forward(const Forward& step, double* body_forces) const {
  Array x;
  solver::Outcome outcome;
  if (nodes_.has_contacts()) {
    outcome = nodes_.solve(step.context, x);
    nodes_.finish(x, step.report, body_forces);
  } else {
    // Pins are at their targets, and so are the bodies, which nothing here looks at.
    const solver::Objective f = problem_.objective(problem_.inertia, problem_.elastic_potentials(),
                                                   problem_.scene.elastic_assemblies);
    x = problem_.predicted(problem_.inertia.target().data());
    // Its way is no motion of the cloth.
    auto* const path = std::exchange(step.context.path, nullptr);
    outcome = solver::minimize(f, x, Motion(problem_), nullptr, nullptr, step.context);
    step.context.path = path;
  }
  merge(outcome, step.report);
  step.factors.push_back(outcome.factor);
  if (!step.tape.empty()) {
    std::copy_n(x.begin(), problem_.cloth_size, step.tape["elastic"]);
  }
  return x;
}

void ElasticStage::backward(const Backward& step, const Array& g, const Array& force_bar) const {
  const Array x = problem_.predicted(step.tape["elastic"]);
  const solver::Factor factor = step.factors.empty() ? nullptr : step.factors.front();
  if (nodes_.has_contacts()) {
    nodes_.backward(step, x, factor, g, force_bar);
    return;
  }
  const solver::Objective f = problem_.objective(problem_.inertia, problem_.elastic_potentials(),
                                                 problem_.scene.elastic_assemblies);
  f.stand_at(x.data());
  pull_back_solve(step, f, x, factor, g, nullptr);
}

}  // namespace diffcloth::step
