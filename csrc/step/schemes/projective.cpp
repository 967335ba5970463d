#include "step/schemes/projective.h"

#include <algorithm>
#include <limits>

#include "step/schemes/elastic_stage.h"

namespace diffcloth::step {

std::vector<Field> Projective::tape(const Scene& scene) const {
  return {{.name = "elastic", .shape = {static_cast<std::size_t>(scene.cloth_vertex_count()), 3}}};
}

void Projective::forward(const Forward& step, std::vector<double>& x, const Forces& forces) const {
  step.report.minimum_distance = std::numeric_limits<double>::infinity();
  if (step.context.path != nullptr) step.context.path->push_back(x);
  x = ElasticStage(step.problem).forward(step, forces);
  if (step.context.path != nullptr) step.context.path->push_back(x);
  step.report.contact_count = step.report.sticking + step.report.slipping;
}

void Projective::backward(const Backward& step) const {
  std::vector<std::vector<double>> g;
  for (const Cotangents& bars : step.losses) g.push_back(bars.rows);
  ElasticStage(step.problem).backward(step, g);
}

std::vector<std::vector<double>> Projective::tangent(const Pushforward& step) const {
  return ElasticStage(step.problem).tangent(step);
}

}  // namespace diffcloth::step
