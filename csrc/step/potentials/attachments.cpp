#include "step/potentials/attachments.h"

#include <algorithm>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/tangents.h"

namespace diffcloth::step {
namespace {

std::vector<double> weighted_stiffness(const Problem& p) {
  std::vector<double> stiffness(p.scene.given.attachments.rest_length.size());
  const double* const k = p.inputs.data(Input::kSpringStiffness);
  const double* const w = p.inputs.data(Input::kSpringWeights);
  for (std::size_t a = 0; a < stiffness.size(); ++a) stiffness[a] = w[a] * k[a];
  return stiffness;
}

}  // namespace

Attachments::Attachments(const Problem& problem)
    : stiffness_(weighted_stiffness(problem)),
      potential_(elastic::Springs{.start = problem.scene.given.attachments.start,
                                  .point = problem.scene.given.attachments.point,
                                  .coefficient = problem.scene.given.attachments.coefficient,
                                  .stiffness = stiffness_,
                                  .rest_length = problem.scene.given.attachments.rest_length,
                                  .target_row = problem.scene.given.attachments.target_row,
                                  .target = problem.inputs.data(Input::kSpringTargets)},
                 problem.scene.cloth_vertex_count(),
                 problem.scene.given.attachments.target_count) {}

void Attachments::pull_back(const Problem& problem,
                            Cotangents& /*bars*/,
                            const Gradients& gradients) {
  add_to(gradients[Input::kSpringTargets], potential_.target_bar);
  const double* const k = problem.inputs.data(Input::kSpringStiffness);
  const double* const w = problem.inputs.data(Input::kSpringWeights);
  double* const k_bar = gradients[Input::kSpringStiffness];
  double* const w_bar = gradients[Input::kSpringWeights];
  for (std::size_t a = 0; a < stiffness_.size(); ++a) {
    if (k_bar != nullptr) k_bar[a] += w[a] * potential_.stiffness_bar[a];
    if (w_bar != nullptr) w_bar[a] += k[a] * potential_.stiffness_bar[a];
  }
}

void Attachments::push_forward(const Problem& problem, const Tangents& tangents) {
  const double* const k = problem.inputs.data(Input::kSpringStiffness);
  const double* const w = problem.inputs.data(Input::kSpringWeights);
  const double* const k_dot = tangents.directions.data(Input::kSpringStiffness);
  const double* const w_dot = tangents.directions.data(Input::kSpringWeights);
  potential_.stiffness_dot.assign(stiffness_.size(), 0.0);
  const std::size_t targets = 3 * problem.scene.given.attachments.target_count;
  potential_.target_dot.assign(targets, 0.0);
  for (std::size_t a = 0; a < stiffness_.size(); ++a) {
    potential_.stiffness_dot[a] = (w_dot ? w_dot[a] * k[a] : 0.0) + (k_dot ? w[a] * k_dot[a] : 0.0);
  }
  if (const double* t = tangents.directions.data(Input::kSpringTargets))
    std::copy_n(t, targets, potential_.target_dot.begin());
}

void Attachments::visit_energy(const double* x, const VisitEnergy& visit) const {
  visit("attachments", potential_.energy(x));
}

void Attachments::accumulate_energy(const double* x, const Seed& seed, double* x_bar) {
  elastic::add_energy_bars(potential_.springs(), x, seed("attachments"),
                           potential_.stiffness_bar.data(), potential_.target_bar.data(), x_bar);
}

}  // namespace diffcloth::step
