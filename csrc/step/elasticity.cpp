#include "step/elasticity.h"

#include <algorithm>
#include <vector>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/tangents.h"

namespace diffcloth::step {
namespace {

elastic::Wanted of_model(const Gradients* wanted) {
  using enum elastic::Wanted;
  if (wanted == nullptr) return kNone;
  if ((*wanted)[Input::kRestPositions] != nullptr) return kMaterialsAndRest;
  for (const Input input : {Input::kStretch, Input::kBending, Input::kPoisson, Input::kDamping}) {
    if ((*wanted)[input] != nullptr) return kMaterials;
  }
  return kNone;
}

elastic::Model make_model(const Problem& p) {
  elastic::Model model;
  model.topology = &p.scene.topology;
  model.stencils = &p.scene.stencils;
  model.rest = p.rest;
  model.stretch = values_per_face(p, Input::kStretch);
  model.bending = values_per_face(p, Input::kBending);
  model.poisson = p.inputs.data(Input::kPoisson) != nullptr
                      ? values_per_face(p, Input::kPoisson)
                      : std::vector<double>(p.scene.face_cloth.size(), 0.0);
  model.damping = values_per_face(p, Input::kDamping);
  model.h = p.h;
  model.x_n = p.inputs.data(Input::kPositions);
  model.held = &p.scene.held_elements;
  if (!p.masses.empty()) model.least_inertia = std::ranges::min(p.masses) / (p.h * p.h);
  elastic::prepare(model, p.scene.slots);
  return model;
}

}  // namespace

Elasticity::Elasticity(const Problem& problem, const Gradients* wanted)
    : model_(make_model(problem)),
      potential_(
          model_, problem.scene.slots, problem.scene.elastic_patterns.base(), of_model(wanted)) {}

void Elasticity::pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) {
  const elastic::Bar& bar = potential_.bar();
  add_per_face(problem, Input::kStretch, bar.stretch, gradients);
  add_per_face(problem, Input::kBending, bar.bending, gradients);
  add_per_face(problem, Input::kPoisson, bar.poisson, gradients);
  add_per_face(problem, Input::kDamping, bar.damping, gradients);
  for (std::size_t a = 0; a < bar.x_n.size(); ++a) bars.start[a] += bar.x_n[a];
  if (gradients[Input::kRestPositions] != nullptr) bars.rest += bar.rest;
}

void Elasticity::push_forward(const Problem& problem, const Tangents& tangents) {
  const auto changes = [&](Input input) { return tangents.directions.data(input) != nullptr; };
  elastic::Changing changing;
  changing.materials = changes(Input::kStretch) || changes(Input::kBending) ||
                       changes(Input::kPoisson) || changes(Input::kDamping);
  changing.rest = !tangents.rest.area.empty();
  changing.start = changes(Input::kPositions);
  elastic::Bar dot;
  dot.stretch = tangents.per_face(problem, Input::kStretch);
  dot.bending = tangents.per_face(problem, Input::kBending);
  dot.poisson = tangents.per_face(problem, Input::kPoisson);
  dot.damping = tangents.per_face(problem, Input::kDamping);
  dot.x_n.assign(tangents.start.begin(),
                 tangents.start.begin() + static_cast<std::ptrdiff_t>(problem.cloth_size));
  dot.rest = tangents.rest;
  potential_.set_tangent(std::move(dot), changing);
}

void Elasticity::visit_energy(const double* x, const VisitEnergy& visit) const {
  visit("stretch", elastic::stretch_energy(model_, x));
  visit("bending", elastic::bending_energy(model_, x));
}

void Elasticity::accumulate_energy(const double* x, const Seed& seed, double* x_bar) {
  elastic::add_energy_bars(model_, x, {.stretch = seed("stretch"), .bending = seed("bending")},
                           potential_.wanted() == elastic::Wanted::kMaterialsAndRest,
                           potential_.bar(), x_bar);
}

}  // namespace diffcloth::step
