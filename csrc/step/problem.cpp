#include "step/problem.h"

#include <algorithm>

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

contact::Parameters contact_parameters(const Scene& scene, const Inputs& in) {
  const auto surfaces = static_cast<std::size_t>(scene.surface_count());
  contact::Parameters p;
  p.kappa = in.data(Input::kBarrierStiffness)[0];
  p.d_hat = in.data(Input::kBarrierDistance)[0];
  p.slip = in.data(Input::kSlipVelocity)[0] * scene.given.dt;
  const double* thickness = in.data(Input::kThickness);
  p.thickness.assign(thickness, thickness + surfaces);
  const View friction = in[Input::kFriction];
  p.friction.assign(surfaces * surfaces, friction.data[0]);
  if (friction.count > 1) std::copy_n(friction.data, surfaces * surfaces, p.friction.begin());
  return p;
}

}  // namespace

Problem::Problem(const Scene& scene_in, const Inputs& inputs_in)
    : scene(scene_in), inputs(inputs_in), h(scene_in.given.dt), rest(&scene_in.rest) {
  const Index n = scene.cloth_vertex_count();
  if (const double* X = inputs.data(Input::kRestPositions)) {
    own_rest_ = mesh::rest_shape(scene.topology, scene.stencils, X);
    rest = &own_rest_;
  }
  measures = rest_measures(scene, *rest);

  density = spread(inputs[Input::kDensity], scene.face_cloth);
  masses.assign(static_cast<std::size_t>(n), 0.0);
  for (std::size_t f = 0; f < density.size(); ++f) {
    for (const Index i : scene.topology.faces[f]) masses[i] += density[f] * rest->area[f] / 3.0;
  }

  const double* x_n = inputs.data(Input::kPositions);
  start.assign(x_n, x_n + 3 * static_cast<std::ptrdiff_t>(n));
  start.resize(3 * static_cast<std::size_t>(scene.vertex_count()));
  ends = start;
  const std::size_t bodies = 3 * static_cast<std::size_t>(n);
  if (scene.given.bodies.count() > 0) {
    scene.given.bodies.place(inputs.data(Input::kBodyPoses), start.data() + bodies);
    scene.given.bodies.place(inputs.data(Input::kBodyTargets), ends.data() + bodies);
  }
  for (std::size_t k = 0; k < scene.given.pins.size(); ++k) {
    Eigen::Map<Vec3>(ends.data() + 3 * scene.given.pins[k]) =
        row(inputs.data(Input::kPinTargets), static_cast<Index>(k));
  }

  const Vec3 gravity = row(inputs.data(Input::kGravity), 0);
  predicted.resize(3 * static_cast<std::size_t>(n));
  for (Index i = 0; i < n; ++i) {
    Eigen::Map<Vec3>(predicted.data() + 3 * i) =
        row(x_n, i) + h * row(inputs.data(Input::kVelocities), i) +
        (h * h) * (gravity + row(inputs.data(Input::kForces), i) / masses[i]);
  }

  elastic.topology = &scene.topology;
  elastic.stencils = &scene.stencils;
  elastic.rest = rest;
  elastic.stretch = spread(inputs[Input::kStretch], scene.face_cloth);
  elastic.bending = spread(inputs[Input::kBending], scene.face_cloth);
  elastic.poisson = inputs.data(Input::kPoisson) != nullptr
                        ? spread(inputs[Input::kPoisson], scene.face_cloth)
                        : std::vector<double>(scene.face_cloth.size(), 0.0);
  elastic.damping = spread(inputs[Input::kDamping], scene.face_cloth);
  elastic.h = h;
  elastic.x_n = x_n;
  elastic::prepare(elastic, scene.slots);

  const std::vector<Index>& soft = scene.given.soft_pins;
  if (!soft.empty()) {
    const View stiffness = inputs[Input::kPinStiffness];
    for (const Index i : soft) {
      anchor_stiffness.push_back(stiffness.data[stiffness.count == 1 ? 0 : scene.vertex_cloth[i]]);
    }
    anchors = {.vertex = soft,
               .stiffness = anchor_stiffness,
               .target = {inputs.data(Input::kSoftPinTargets), 3 * soft.size()}};
  }
  if (inputs.data(Input::kBarrierStiffness) != nullptr) {
    contact.emplace(scene.collision_mesh, scene.feature_weights, measures,
                    contact_parameters(scene, inputs), scene.prescribed);
  }
}

solver::Objective Problem::bare_objective() const {
  return {.cloth_vertex_count = scene.cloth_vertex_count(),
          .vertex_count = scene.vertex_count(),
          .h = h,
          .prescribed = &scene.prescribed,
          .metric = {},
          .target = {},
          .friction = {},
          .x_start = start.data(),
          .assemblies = nullptr};
}

solver::Objective Problem::elastic_objective() const {
  solver::Objective f = bare_objective();
  f.metric = masses;
  f.target = predicted;
  f.elastic = &elastic;
  f.slots = &scene.slots;
  if (!scene.given.soft_pins.empty()) f.anchors = &anchors;
  if (contact && !split()) f.contact = &*contact;
  f.assemblies = &scene.elastic_assemblies;
  return f;
}

std::vector<double> Problem::stage_metric() const {
  if (scene.given.metric == Metric::kMass) return masses;
  // The literal metric weighs all vertices alike; the mean mass keeps the energy in joules.
  double mean = 0.0;
  for (const double m : masses) mean += m;
  mean /= static_cast<double>(masses.size());
  return std::vector<double>(masses.size(), mean);
}

solver::Objective Problem::contact_objective(const double* x_d) const {
  solver::Objective f = bare_objective();
  f.metric = stage_metric();
  f.target.assign(x_d, x_d + 3 * masses.size());
  if (contact) f.contact = &*contact;
  f.assemblies = &scene.diagonal_assemblies;
  return f;
}

solver::Objective Problem::main_objective(const double* x_d) const {
  return split() ? contact_objective(x_d) : elastic_objective();
}

std::vector<double> Problem::with_bodies_at_end(const double* cloth_positions) const {
  std::vector<double> x = ends;
  std::copy_n(cloth_positions, 3 * masses.size(), x.begin());
  return x;
}

}  // namespace diffcloth::step
