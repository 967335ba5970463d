#include "step/coupled.h"

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

void Coupled::forward(const Forward& step, std::vector<double>& x, double* body_forces) const {
  stage(step.problem).forward(step, x, body_forces);
}

void Coupled::backward(const Backward& step) const {
  stage(step.problem).backward(step, step.cotangents.rows);
}

}  // namespace diffcloth::step
