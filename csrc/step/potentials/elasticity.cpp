#include "step/potentials/elasticity.h"

#include <algorithm>
#include <array>
#include <vector>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/tangents.h"

namespace diffcloth::step {
namespace {

/// An input with one value a face, and its members in models and their cotangents.
struct FaceValue {
  Input input;
  std::vector<double> elastic::Model::* value;
  std::vector<double> elastic::Bar::* bar;
};

using elastic::Bar;
using elastic::Model;
constexpr std::array kFaceValues{
    FaceValue{.input = Input::kStretch, .value = &Model::stretch, .bar = &Bar::stretch},
    FaceValue{.input = Input::kBending, .value = &Model::bending, .bar = &Bar::bending},
    FaceValue{.input = Input::kPoisson, .value = &Model::poisson, .bar = &Bar::poisson},
    FaceValue{.input = Input::kDamping, .value = &Model::damping, .bar = &Bar::damping},
    FaceValue{
        .input = Input::kStretchWeft, .value = &Model::stretch_weft, .bar = &Bar::stretch_weft},
    FaceValue{
        .input = Input::kStretchShear, .value = &Model::stretch_shear, .bar = &Bar::stretch_shear},
    FaceValue{
        .input = Input::kBendingWeft, .value = &Model::bending_weft, .bar = &Bar::bending_weft},
    FaceValue{
        .input = Input::kBendingTwill, .value = &Model::bending_twill, .bar = &Bar::bending_twill},
};

elastic::Wanted of_model(const Gradients* wanted) {
  using enum elastic::Wanted;
  if (wanted == nullptr) return kNone;
  if ((*wanted)[Input::kRestPositions] != nullptr) return kMaterialsAndRest;
  const auto is_wanted = [&](const FaceValue& m) { return (*wanted)[m.input] != nullptr; };
  return std::ranges::any_of(kFaceValues, is_wanted) ? kMaterials : kNone;
}

void prepare(const Problem& p, elastic::Model& model) {
  if (p.rest == &p.scene.rest) {
    p.scene.prepared.prepare(model, p.scene.slots);
  } else {
    elastic::prepare(model, p.scene.slots);
  }
}

elastic::Model make_model(const Problem& p) {
  elastic::Model model;
  model.topology = &p.scene.topology;
  model.stencils = &p.scene.stencils;
  model.rest = p.rest;
  for (const FaceValue& m : kFaceValues) {
    if (p.inputs.data(m.input) != nullptr) model.*m.value = values_per_face(p, m.input);
  }
  model.poisson.resize(p.scene.face_cloth.size(), 0.0);
  model.axes = &p.scene.material_axes;
  // Steps of second order count damping over the filter and the step: see elastic/damping.h.
  const bool twice = p.scene.given.integrator == Integrator::kSecondOrder;
  model.h = twice ? 2.0 * p.h : p.h;
  model.x_n = p.inputs.data(Input::kPositions);
  model.held = &p.scene.held_elements;
  if (!p.masses.empty()) model.least_inertia = std::ranges::min(p.masses) / (p.h * p.h);
  prepare(p, model);
  return model;
}

}  // namespace

Elasticity::Elasticity(const Problem& problem, const Gradients* wanted)
    : model_(make_model(problem)),
      potential_(
          model_, problem.scene.slots, problem.scene.elastic_patterns.base(), of_model(wanted)) {}

void Elasticity::predict(const Problem& problem, const double* end) {
  model_.ahead = end;
  if (!model_.prepared->has_damping) return;
  prepare(problem, model_);
  potential_.renew();
}

void Elasticity::pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) {
  const elastic::Bar& bar = potential_.bar();
  for (const FaceValue& m : kFaceValues) add_per_face(problem, m.input, bar.*m.bar, gradients);
  for (std::size_t a = 0; a < bar.x_n.size(); ++a) bars.start[a] += bar.x_n[a];
  if (gradients[Input::kRestPositions] != nullptr) bars.rest += bar.rest;
}

void Elasticity::push_forward(const Problem& problem, const Tangents& tangents) {
  const auto changes = [&](Input input) { return tangents.directions.data(input) != nullptr; };
  elastic::Changing changing;
  changing.materials =
      std::ranges::any_of(kFaceValues, [&](const FaceValue& m) { return changes(m.input); });
  changing.rest = !tangents.rest.area.empty();
  changing.start = changes(Input::kPositions);
  elastic::Bar dot;
  for (const FaceValue& m : kFaceValues) dot.*m.bar = tangents.per_face(problem, m.input);
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
