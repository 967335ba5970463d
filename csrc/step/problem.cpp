#include "step/problem.h"

#include <algorithm>
#include <utility>

#include "solver/linear_system.h"

namespace diffcloth::step {

namespace {

/// One value, or one for each pair of surfaces, for each pair.
std::vector<double> values_per_pair(const View& view, std::size_t surfaces) {
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
  p.kappa = values_per_pair(in[Input::kBarrierStiffness], surfaces);
  p.friction = values_per_pair(in[Input::kFriction], surfaces);
  return p;
}

/// Rest shape of the rest_positions input; empty if absent: the scene's rest shape then holds.
mesh::RestShape own_rest_shape(const Scene& scene, const Inputs& in) {
  const double* X = in.data(Input::kRestPositions);
  return X == nullptr ? mesh::RestShape() : mesh::rest_shape(scene.topology, scene.stencils, X);
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

std::vector<double> origin_positions(const Inputs& in, std::vector<double> x) {
  const View origins = in[Input::kFrictionOrigins];
  if (origins.data == nullptr) return {};
  std::copy_n(origins.data, origins.count, x.data());
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

}  // namespace

std::vector<double> values_per_face(const Problem& problem, Input input) {
  const View& view = problem.inputs[input];
  const std::vector<Index>& owner = problem.scene.face_cloth;
  std::vector<double> result(owner.size());
  for (std::size_t f = 0; f < owner.size(); ++f) {
    result[f] = view.count == 1              ? view.data[0]
                : view.count == owner.size() ? view.data[f]
                                             : view.data[owner[f]];
  }
  return result;
}

void add_per_face(const Problem& problem,
                  Input input,
                  const std::vector<double>& bar,
                  const Gradients& gradients) {
  double* const out = gradients[input];
  if (out == nullptr) return;
  const std::size_t count = problem.inputs[input].count;
  const std::vector<Index>& owner = problem.scene.face_cloth;
  for (std::size_t f = 0; f < owner.size(); ++f) {
    out[count == 1 ? 0 : count == owner.size() ? f : owner[f]] += bar[f];
  }
}

std::vector<double> lumped(const Problem& problem, const std::vector<double>& per_face) {
  std::vector<double> result(static_cast<std::size_t>(problem.scene.cloth_vertex_count()), 0.0);
  for (std::size_t f = 0; f < per_face.size(); ++f) {
    for (const Index i : problem.scene.topology.faces[f]) {
      result[i] += per_face[f] * problem.rest->area[f] / 3.0;
    }
  }
  return result;
}

Problem::Problem(const Scene& scene_in, const Inputs& inputs_in, const Gradients* wanted)
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
      density(values_per_face(*this, Input::kDensity)),
      masses(lumped(*this, density)),
      start(start_positions(scene, inputs)),
      ends(end_positions(scene, inputs, start)),
      origins(origin_positions(inputs, start)),
      inertia(masses, predicted_positions(inputs, masses, h), h),
      potentials(make_potentials(*this, wanted)) {
  if (scene.mechanisms.has_free()) {
    chart.emplace(scene.mechanisms, scene.vertex_count(), scene.cloth_vertex_count(),
                  inputs.data(Input::kCoordinateTargets), inputs.data(Input::kCoordinateMetric),
                  inputs.data(Input::kJointTerms), h);
  }
  if (inputs.data(Input::kBarrierStiffness) != nullptr) {
    contact.emplace(scene.collision_mesh, scene.feature_weights, measures,
                    contact_parameters(scene, inputs), scene.prescribed);
  }
}

std::vector<Potential*> Problem::cloth_potentials() const {
  std::vector<Potential*> result;
  result.reserve(potentials.size());
  for (const auto& potential : potentials) result.push_back(&potential->potential());
  return result;
}

solver::Objective Problem::objective(Proximity& inertia_or_nearness,
                                     std::vector<Potential*> others,
                                     solver::PatternCache& patterns) {
  return {.coordinates = &coordinates,
          .h = h,
          .length = scene.mean_edge,
          .inertia = &inertia_or_nearness,
          .others = std::move(others),
          .chart = chart ? &*chart : nullptr,
          .free_bodies = scene.free_bodies,
          .patterns = &patterns,
          .expected = {},
          .of_friction = {},
          .known_pattern = {}};
}

linalg::BlockMatrix contact_free_hessian(Problem& p, const double* x, Curvature curvature) {
  const solver::Objective f =
      p.objective(p.inertia, p.cloth_potentials(), p.scene.elastic_patterns);
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

std::vector<double> Problem::coasting() const {
  std::vector<double> x = ends;
  const double* velocities = inputs.data(Input::kVelocities);
  for (std::size_t a = 0; a < cloth_size; ++a) {
    if (scene.prescribed[a / 3] == 0) x[a] += h * velocities[a];
  }
  return x;
}

std::vector<double> Problem::predicted(const double* cloth_positions) const {
  std::vector<double> x = ends;
  std::copy_n(cloth_positions, cloth_size, x.begin());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    if (scene.mechanisms.given().prescribed[c] != 0) continue;
    double target = inputs.data(Input::kCoordinateTargets)[c];
    if (chart) target = chart->within_speed(c, target);
    coordinates.nodes(x)[scene.mechanisms.slot(c)] = target;
  }
  coordinates.place(x);
  for (const Index i : scene.given.pins) {
    Eigen::Map<Vec3>(x.data() + 3 * i) = row(ends.data(), i);
  }
  return x;
}

}  // namespace diffcloth::step
