#include "step/problem.h"

#include <algorithm>
#include <utility>

#include "solver/linear_system.h"

namespace diffcloth::step {

std::vector<double> spread(const View& view, const std::vector<Index>& owner) {
  std::vector<double> result(owner.size());
  for (std::size_t f = 0; f < owner.size(); ++f) {
    result[f] = view.count == 1              ? view.data[0]
                : view.count == owner.size() ? view.data[f]
                                             : view.data[owner[f]];
  }
  return result;
}

void gather(const std::vector<double>& bar,
            const std::vector<Index>& owner,
            View view,
            double* out) {
  for (std::size_t f = 0; f < owner.size(); ++f) {
    out[view.count == 1 ? 0 : view.count == owner.size() ? f : owner[f]] += bar[f];
  }
}

namespace {

/// One value, or one for each pair of surfaces, for each pair.
std::vector<double> spread_pairs(const View& view, std::size_t surfaces) {
  const std::size_t pairs = surfaces * surfaces;
  if (view.count == 1) return std::vector<double>(pairs, view.data[0]);
  return {view.data, view.data + pairs};
}

contact::Parameters contact_parameters(const Scene& scene, const Inputs& in) {
  const auto surfaces = static_cast<std::size_t>(scene.surface_count());
  contact::Parameters p;
  p.d_hat = in.data(Input::kBarrierDistance)[0];
  p.slip = in.data(Input::kSlipVelocity)[0] * scene.given.dt;
  const double* thickness = in.data(Input::kThickness);
  p.thickness.assign(thickness, thickness + surfaces);
  p.kappa = spread_pairs(in[Input::kBarrierStiffness], surfaces);
  p.friction = spread_pairs(in[Input::kFriction], surfaces);
  return p;
}

/// Of the rest_positions input; empty where the scene's own holds.
mesh::RestShape own_rest_shape(const Scene& scene, const Inputs& in) {
  const double* X = in.data(Input::kRestPositions);
  return X == nullptr ? mesh::RestShape() : mesh::rest_shape(scene.topology, scene.stencils, X);
}

std::vector<double> lumped_masses(const Scene& scene,
                                  const mesh::RestShape& rest,
                                  const std::vector<double>& density) {
  std::vector<double> masses(static_cast<std::size_t>(scene.cloth_vertex_count()), 0.0);
  for (std::size_t f = 0; f < density.size(); ++f) {
    for (const Index i : scene.topology.faces[f]) masses[i] += density[f] * rest.area[f] / 3.0;
  }
  return masses;
}

std::vector<double> start_positions(const Scene& scene, const Inputs& in) {
  const double* x_n = in.data(Input::kPositions);
  const std::ptrdiff_t cloth = 3 * static_cast<std::ptrdiff_t>(scene.cloth_vertex_count());
  std::vector<double> x(x_n, x_n + cloth);
  x.resize(3 * static_cast<std::size_t>(scene.point_count()), 0.0);
  if (scene.given.bodies.count() > 0) {
    scene.given.bodies.place(in.data(Input::kBodyPoses), x.data() + cloth);
  }
  double* const nodes = x.data() + 3 * static_cast<std::ptrdiff_t>(scene.vertex_count());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    nodes[scene.mechanisms.slot(c)] = in.data(Input::kCoordinates)[c];
  }
  if (!scene.mechanisms.empty()) {
    scene.mechanisms.set_frames(in.data(Input::kBodyPoses), nodes);
    scene.mechanisms.place(nodes, x.data() + cloth);
  }
  return x;
}

std::vector<double> origin_positions(const Scene& scene, const Inputs& in, std::vector<double> x) {
  if (in.data(Input::kCoordinateOrigins) == nullptr || scene.mechanisms.empty()) return {};
  double* const nodes = x.data() + 3 * static_cast<std::ptrdiff_t>(scene.vertex_count());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    nodes[scene.mechanisms.slot(c)] = in.data(Input::kCoordinateOrigins)[c];
  }
  scene.mechanisms.place(nodes,
                         x.data() + 3 * static_cast<std::ptrdiff_t>(scene.cloth_vertex_count()));
  return x;
}

std::vector<double> end_positions(const Scene& scene, const Inputs& in, std::vector<double> x) {
  double* const bodies = x.data() + 3 * static_cast<std::ptrdiff_t>(scene.cloth_vertex_count());
  if (scene.given.bodies.count() > 0) {
    scene.given.bodies.place(in.data(Input::kBodyTargets), bodies);
  }
  double* const nodes = x.data() + 3 * static_cast<std::ptrdiff_t>(scene.vertex_count());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    if (scene.mechanisms.given().prescribed[c] == 0) continue;
    nodes[scene.mechanisms.slot(c)] = in.data(Input::kCoordinateEnds)[c];
  }
  if (!scene.mechanisms.empty()) {
    scene.mechanisms.set_frames(in.data(Input::kBodyTargets), nodes);
    scene.mechanisms.place(nodes, bodies);
  }
  for (std::size_t k = 0; k < scene.given.pins.size(); ++k) {
    Eigen::Map<Vec3>(x.data() + 3 * scene.given.pins[k]) =
        row(in.data(Input::kPinTargets), static_cast<Index>(k));
  }
  return x;
}

std::vector<double> predicted_positions(const Inputs& in,
                                        const std::vector<double>& masses,
                                        double h) {
  const Vec3 gravity = row(in.data(Input::kGravity), 0);
  std::vector<double> xhat(3 * masses.size());
  for (std::size_t i = 0; i < masses.size(); ++i) {
    const auto v = static_cast<Index>(i);
    Eigen::Map<Vec3>(xhat.data() + 3 * i) =
        row(in.data(Input::kPositions), v) + h * row(in.data(Input::kVelocities), v) +
        (h * h) * (gravity + row(in.data(Input::kForces), v) / masses[i]);
  }
  return xhat;
}

elastic::Model elastic_model(const Scene& scene,
                             const Inputs& in,
                             const mesh::RestShape& rest,
                             const std::vector<double>& masses,
                             double h) {
  elastic::Model model;
  model.topology = &scene.topology;
  model.stencils = &scene.stencils;
  model.rest = &rest;
  model.stretch = spread(in[Input::kStretch], scene.face_cloth);
  model.bending = spread(in[Input::kBending], scene.face_cloth);
  model.poisson = in.data(Input::kPoisson) != nullptr
                      ? spread(in[Input::kPoisson], scene.face_cloth)
                      : std::vector<double>(scene.face_cloth.size(), 0.0);
  model.damping = spread(in[Input::kDamping], scene.face_cloth);
  model.h = h;
  model.x_n = in.data(Input::kPositions);
  model.held = &scene.held_elements;
  if (!masses.empty()) model.least_inertia = std::ranges::min(masses) / (h * h);
  elastic::prepare(model, scene.slots);
  return model;
}

}  // namespace

Problem::Problem(const Scene& scene_in, const Inputs& inputs_in, elastic::Wanted wanted)
    : scene(scene_in),
      inputs(inputs_in),
      h(scene_in.given.dt),
      coordinates(scene_in.cloth_vertex_count(),
                  scene_in.vertex_count(),
                  scene_in.mechanisms,
                  scene_in.prescribed),
      cloth_size(3 * static_cast<std::size_t>(scene_in.cloth_vertex_count())),
      own_rest_(own_rest_shape(scene, inputs)),
      rest(own_rest_.area.empty() ? &scene.rest : &own_rest_),
      measures(rest_measures(scene, *rest)),
      density(spread(inputs[Input::kDensity], scene.face_cloth)),
      masses(lumped_masses(scene, *rest, density)),
      start(start_positions(scene, inputs)),
      ends(end_positions(scene, inputs, start)),
      origins(origin_positions(scene, inputs, start)),
      inertia(masses, predicted_positions(inputs, masses, h), h),
      model(elastic_model(scene, inputs, *rest, masses, h)),
      elasticity(model, scene.slots, scene.elastic_assemblies.base(), wanted) {
  const std::vector<Index>& soft = scene.given.soft_pins;
  if (!soft.empty()) {
    const View stiffness = inputs[Input::kPinStiffness];
    for (const Index i : soft) {
      anchor_stiffness.push_back(stiffness.data[stiffness.count == 1 ? 0 : scene.vertex_cloth[i]]);
    }
    anchors.emplace(
        elastic::Anchors{.vertex = soft,
                         .stiffness = anchor_stiffness,
                         .target = {inputs.data(Input::kSoftPinTargets), 3 * soft.size()}});
  }
  if (scene.mechanisms.has_free()) {
    chart.emplace(scene.mechanisms, scene.vertex_count(), scene.cloth_vertex_count(),
                  inputs.data(Input::kCoordinateTargets), inputs.data(Input::kCoordinateMetric));
  }
  if (inputs.data(Input::kBarrierStiffness) != nullptr) {
    contact.emplace(scene.collision_mesh, scene.feature_weights, measures,
                    contact_parameters(scene, inputs), scene.prescribed);
  }
}

std::vector<Potential*> Problem::elastic_potentials() {
  std::vector<Potential*> result{&elasticity};
  if (anchors) result.push_back(&*anchors);
  return result;
}

elastic::ConstantForm Problem::constant_form() const {
  return {model, scene.slots, anchors ? anchors->anchors() : elastic::Anchors{},
          scene.elastic_assemblies.base()};
}

std::shared_ptr<const projective::ConstantMatrix> Problem::constant_matrix() const {
  const elastic::ConstantForm form = constant_form();
  std::vector<double> values(form.values().begin(), form.values().end());
  for (std::size_t i = 0; i < masses.size(); ++i) {
    values[form.pattern().column_start()[i]] += masses[i] / (h * h);
  }
  return scene.constant_matrices.find(values);
}

solver::Objective Problem::objective(Proximity& inertia_or_nearness,
                                     std::vector<Potential*> others,
                                     solver::AssemblyCache& assemblies) {
  return {.coordinates = &coordinates,
          .h = h,
          .length = scene.mean_edge,
          .inertia = &inertia_or_nearness,
          .others = std::move(others),
          .chart = chart ? &*chart : nullptr,
          .assemblies = &assemblies};
}

linalg::BlockMatrix contact_free_hessian(Problem& p, const double* x, Curvature curvature) {
  const solver::Objective f =
      p.objective(p.inertia, p.elastic_potentials(), p.scene.elastic_assemblies);
  Stopwatch watch;
  solver::Counts counts;
  linalg::CholeskyWorkspace workspace;
  std::vector<double> g;
  f.gradient(x, g);
  return solver::LinearSystem(f, workspace, watch, counts).assemble(x, curvature, g);
}

std::vector<double> Problem::at(const double* rows) const {
  std::vector<double> x = ends;
  coordinates.put_rows(rows, x);
  coordinates.place(x);
  return x;
}

std::vector<double> Problem::predicted(const double* cloth_positions) const {
  std::vector<double> x = ends;
  std::copy_n(cloth_positions, cloth_size, x.begin());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    if (scene.mechanisms.given().prescribed[c] != 0) continue;
    coordinates.nodes(x)[scene.mechanisms.slot(c)] = inputs.data(Input::kCoordinateTargets)[c];
  }
  coordinates.place(x);
  for (const Index i : scene.given.pins) {
    Eigen::Map<Vec3>(x.data() + 3 * i) = row(ends.data(), i);
  }
  return x;
}

}  // namespace diffcloth::step
