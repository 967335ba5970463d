// The adjoint of `split` is that of its contact stage (contact_stage.cpp), whose target is x^D; the
// cotangent of x^D is the g of one more adjoint of the same form, that of the elastic stage: the
// paper's Eqs. 8 and 29 with all explicit terms.

#include "step/split.h"

#include <algorithm>

#include "step/contact_stage.h"
#include "step/elastic_stage.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// G_i of the contact stage [kg].
Array stage_metric(const Problem& p) {
  if (p.scene.given.metric == Metric::kMass) return p.masses;
  // The literal metric weighs all vertices alike; the mean mass keeps the energy in joules.
  double mean = 0.0;
  for (const double m : p.masses) mean += m;
  mean /= static_cast<double>(p.masses.size());
  Array metric(p.masses.size(), mean);
  return metric;
}

/// Its adjoint: into the masses.
void add_stage_metric(const Problem& p, const Array& bar, Array& masses_bar) {
  double mean = 0.0;
  for (const double value : bar) mean += value;
  mean /= static_cast<double>(bar.size());
  for (std::size_t i = 0; i < bar.size(); ++i) {
    masses_bar[i] += p.scene.given.metric == Metric::kMass ? bar[i] : mean;
  }
}

ContactStage stage(Problem& problem, Proximity& nearness) {
  return {.inertia = nearness,
          .others = {},
          .assemblies = problem.scene.diagonal_assemblies,
          .first_factor = 1};
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
  Array x_d = ElasticStage(problem, false).forward(step, body_forces);
  x_d.resize(problem.cloth_size);

  Proximity nearness(stage_metric(problem), std::move(x_d), problem.h);
  stage(problem, nearness).forward(step, x, body_forces);
}

void Split::backward(const Backward& step) const {
  Problem& problem = step.problem;
  const double* x_d = step.tape["elastic"];
  Proximity nearness(stage_metric(problem), Array(x_d, x_d + problem.cloth_size), problem.h);
  stage(problem, nearness).backward(step, step.cotangents.rows);
  add_stage_metric(problem, nearness.metric_bar, step.cotangents.masses);

  Array g = nearness.target_bar;
  g.resize(problem.coordinates.size(), 0.0);
  ElasticStage(problem, false).backward(step, g, step.cotangents.body_forces);
}

}  // namespace diffcloth::step
