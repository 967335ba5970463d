#include "step/schemes/coupled.h"

#include <cstddef>
#include <utility>

#include "step/potentials/attachments.h"
#include "step/schemes/contact_stage.h"

namespace diffcloth::step {
namespace {

ContactStage stage(Problem& problem) {
  return {.inertia = problem.inertia,
          .guess = problem.inertia.target().data(),
          .others = problem.cloth_potentials(),
          .patterns = problem.scene.elastic_patterns,
          .first_factor = 0,
          .attachments = &problem.find<Attachments>().potential(),
          .exchange = {},
          .set_tangents = {}};
}

}  // namespace

std::vector<Field> Coupled::tape(const Scene& scene) const { return ContactStage::tape(scene); }

void Coupled::forward(const Forward& step, std::vector<double>& x, const Forces& forces) const {
  stage(step.problem).forward(step, x, forces);
}

void Coupled::backward(const Backward& step) const {
  ContactStage contact = stage(step.problem);
  contact.exchange = [&](std::size_t l) { step.losses[l].exchange(step.problem); };
  std::vector<std::vector<double>> g;
  for (const Cotangents& bars : step.losses) g.push_back(bars.rows);
  contact.backward(step, std::move(g));
}

std::vector<std::vector<double>> Coupled::tangent(const Pushforward& step) const {
  ContactStage contact = stage(step.problem);
  contact.set_tangents = [&](std::size_t l) { step.directions[l].push_forward(step.problem); };
  return contact.tangent(step);
}

}  // namespace diffcloth::step
