#include "step/coupled.h"

#include <algorithm>

#include "step/contact_stage.h"

namespace diffcloth::step {
namespace {

ContactStage stage(Problem& problem) {
  return {.inertia = problem.inertia,
          .others = problem.elastic_potentials(),
          .assemblies = problem.scene.elastic_assemblies,
          .first_factor = 0};
}

}  // namespace

std::vector<Field> Coupled::tape(const Scene& scene) const { return ContactStage::tape(scene); }

void Coupled::forward(const Forward& step, double* positions, double* body_forces) const {
  std::vector<double> x = step.problem.start;
  stage(step.problem).forward(step, x, body_forces);
  std::copy_n(x.begin(), step.problem.coordinates.size(), positions);
}

void Coupled::backward(const Backward& step) const {
  stage(step.problem).backward(step, step.cotangents.positions);
}

}  // namespace diffcloth::step
