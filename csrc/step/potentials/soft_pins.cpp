#include "step/potentials/soft_pins.h"

#include <algorithm>
#include <numeric>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/tangents.h"

namespace diffcloth::step {
namespace {

std::vector<Index> counting(std::size_t count) {
  std::vector<Index> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

std::vector<double> stiffness_of_pins(const Problem& p) {
  const View given = p.inputs[Input::kPinStiffness];
  std::vector<double> stiffness;
  stiffness.reserve(p.scene.given.soft_pins.size());
  for (const Index i : p.scene.given.soft_pins) {
    stiffness.push_back(given.data[given.count == 1 ? 0 : p.scene.vertex_cloth[i]]);
  }
  return stiffness;
}

}  // namespace

SoftPins::SoftPins(const Problem& problem)
    : start_(counting(problem.scene.given.soft_pins.size() + 1)),
      coefficient_(problem.scene.given.soft_pins.size(), 1.0),
      stiffness_(stiffness_of_pins(problem)),
      potential_(elastic::Springs{.start = start_,
                                  .point = problem.scene.given.soft_pins,
                                  .coefficient = coefficient_,
                                  .stiffness = stiffness_,
                                  .rest_length = {},
                                  .target_row = {start_.data(), coefficient_.size()},
                                  .target = problem.inputs.data(Input::kSoftPinTargets)},
                 problem.scene.cloth_vertex_count(),
                 static_cast<Index>(coefficient_.size())) {}

void SoftPins::pull_back(const Problem& problem, Cotangents& /*bars*/, const Gradients& gradients) {
  add_to(gradients[Input::kSoftPinTargets], potential_.target_bar);
  double* const out = gradients[Input::kPinStiffness];
  if (out == nullptr) return;
  const bool one = problem.inputs[Input::kPinStiffness].count == 1;
  const std::vector<Index>& soft = problem.scene.given.soft_pins;
  for (std::size_t k = 0; k < soft.size(); ++k) {
    out[one ? 0 : problem.scene.vertex_cloth[soft[k]]] += potential_.stiffness_bar[k];
  }
}

void SoftPins::push_forward(const Problem& problem, const Tangents& tangents) {
  const std::vector<Index>& soft = problem.scene.given.soft_pins;
  potential_.stiffness_dot.assign(soft.size(), 0.0);
  potential_.target_dot.assign(3 * soft.size(), 0.0);
  if (const double* t = tangents.directions.data(Input::kSoftPinTargets))
    std::copy_n(t, 3 * soft.size(), potential_.target_dot.begin());
  if (const double* t = tangents.directions.data(Input::kPinStiffness)) {
    const bool one = problem.inputs[Input::kPinStiffness].count == 1;
    for (std::size_t k = 0; k < soft.size(); ++k)
      potential_.stiffness_dot[k] = t[one ? 0 : problem.scene.vertex_cloth[soft[k]]];
  }
}

void SoftPins::visit_energy(const double* x, const VisitEnergy& visit) const {
  visit("soft_pins", potential_.energy(x));
}

void SoftPins::accumulate_energy(const double* x, const Seed& seed, double* x_bar) {
  elastic::add_energy_bars(potential_.springs(), x, seed("soft_pins"),
                           potential_.stiffness_bar.data(), potential_.target_bar.data(), x_bar);
}

}  // namespace diffcloth::step
