#include "step/cotangents.h"

#include <algorithm>
#include <utility>

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Like add_to(), for an input with one value for all pairs of surfaces, or one for each pair.
void add_pairs_to(double* out, const View& input, const Array& bar) {
  if (out == nullptr) return;
  for (std::size_t k = 0; k < bar.size(); ++k) out[input.count == 1 ? 0 : k] += bar[k];
}

void write_surfaces(const Problem& p, const Cotangents& bars, const Gradients& gradients) {
  const bodies::BodySet& bodies = p.scene.given.bodies;
  const bodies::Mechanisms& mechanisms = p.scene.mechanisms;
  Array start = bars.start;
  p.coordinates.gather(p.start, start);
  if (double* out = gradients[Input::kFrictionOrigins]) {
    for (std::size_t a = 0; a < p.inputs[Input::kFrictionOrigins].count; ++a) {
      out[a] += bars.origins[a];
    }
  }
  if (double* out = gradients[Input::kBodyPoses]) {
    const double* poses = p.inputs.data(Input::kBodyPoses);
    bodies.place_vjp(poses, start.data() + p.cloth_size, out);
    mechanisms.set_frames_vjp(poses, p.coordinates.nodes(start), out);
  }
  if (double* out = gradients[Input::kBodyTargets]) {
    const double* poses = p.inputs.data(Input::kBodyTargets);
    bodies.place_vjp(poses, bars.ends.data() + p.cloth_size, out);
    mechanisms.set_frames_vjp(poses, p.coordinates.nodes(bars.ends), out);
  }
  for (Index c = 0; c < mechanisms.coordinate_count(); ++c) {
    const Index slot = mechanisms.slot(c);
    if (double* out = gradients[Input::kCoordinates]) out[c] += p.coordinates.nodes(start)[slot];
    double* const out = gradients[Input::kCoordinateEnds];
    if (out != nullptr && mechanisms.given().prescribed[c] != 0) {
      out[c] += p.coordinates.nodes(bars.ends)[slot];
    }
  }
  if (p.chart) {
    add_to(gradients[Input::kCoordinateTargets], p.chart->target_bar);
    add_to(gradients[Input::kCoordinateMetric], p.chart->metric_bar);
    add_to(gradients[Input::kJointTerms], p.chart->joint_bar);
  }
  if (double* out = gradients[Input::kBarrierDistance]) *out += bars.contact.d_hat;
  if (double* out = gradients[Input::kSlipVelocity]) *out += p.h * bars.contact.slip;
  add_to(gradients[Input::kThickness], bars.contact.thickness);
  add_pairs_to(gradients[Input::kBarrierStiffness], p.inputs[Input::kBarrierStiffness],
               bars.contact.kappa);
  add_pairs_to(gradients[Input::kFriction], p.inputs[Input::kFriction], bars.contact.friction);
}

/// The rest shape acts through the potentials of the cloths, masses and the contacts' weights and
/// mollifiers.
void write_rest(const Problem& p, Cotangents& bars, const Gradients& gradients) {
  double* out = gradients[Input::kRestPositions];
  if (out == nullptr) return;
  mesh::RestShapeBar& rest = bars.rest;
  const std::vector<Index>& start = p.scene.given.cloth_face_start;
  for (Index c = 0; c < p.scene.cloth_count(); ++c) {
    const double share = bars.contact.rest.mean_face_area[c] / (start[c + 1] - start[c]);
    for (Index f = start[c]; f < start[c + 1]; ++f) {
      rest.area[f] += share + bars.contact.rest.face_area[f];
    }
  }
  for (std::size_t i = 0; i < rest.vertex_area.size(); ++i) {
    rest.vertex_area[i] += bars.contact.rest.vertex_area[i];
  }
  for (std::size_t e = 0; e < rest.edge_area.size(); ++e) {
    rest.edge_area[e] += bars.contact.rest.edge_area[e];
    rest.edge_length_sq[e] += bars.contact.rest.edge_length_sq[e];
  }
  const double* X = p.inputs.data(Input::kRestPositions);
  mesh::rest_shape_vjp(p.scene.topology, p.scene.stencils,
                       X != nullptr ? X : p.scene.given.rest_positions.data(), rest, out);
}

}  // namespace

void add_to(double* out, const Array& bar) {
  if (out == nullptr) return;
  for (std::size_t a = 0; a < bar.size(); ++a) out[a] += bar[a];
}

void pull_back_lumped(const Problem& p,
                      Input input,
                      const Array& bar,
                      const Array& per_face,
                      Cotangents& bars,
                      const Gradients& gradients) {
  const auto& faces = p.scene.topology.faces;
  Array sums(faces.size(), 0.0);
  for (std::size_t f = 0; f < faces.size(); ++f) {
    for (const Index i : faces[f]) sums[f] += bar[i];
  }
  for (std::size_t f = 0; f < bars.rest.area.size(); ++f) {
    bars.rest.area[f] += sums[f] * per_face[f] / 3.0;
  }
  for (std::size_t f = 0; f < faces.size(); ++f) sums[f] *= p.rest->area[f] / 3.0;
  add_per_face(p, input, sums, gradients);
}

Cotangents::Cotangents(const Problem& p, const Gradients& gradients)
    : start(p.start.size(), 0.0),
      origins(p.origins.size(), 0.0),
      ends(p.start.size(), 0.0),
      velocities(p.cloth_size, 0.0),
      masses(p.masses.size(), 0.0),
      contact(p.scene.collision_mesh) {
  if (gradients[Input::kRestPositions] != nullptr) {
    rest = mesh::RestShapeBar(p.scene.topology, p.scene.stencils);
  }
}

void Cotangents::exchange(Problem& p) {
  store_.begin();
  p.inertia.swap_cotangents(store_);
  for (Potential* potential : p.cloth_potentials()) potential->swap_cotangents(store_);
  if (p.chart) p.chart->swap_cotangents(store_);
}

void Cotangents::add_predicted(Problem& p, const Gradients& gradients) {
  const double h = p.h;
  double* gravity = gradients[Input::kGravity];
  double* forces = gradients[Input::kForces];
  for (std::size_t i = 0; i < p.masses.size(); ++i) {
    const auto v = static_cast<Index>(i);
    const double m = p.masses[i];
    const Vec3 y_bar = row(p.inertia.target_bar.data(), v);
    Eigen::Map<Vec3>(start.data() + 3 * i) += y_bar;
    Eigen::Map<Vec3>(velocities.data() + 3 * i) += h * y_bar;
    if (gravity != nullptr) Eigen::Map<Vec3>(gravity) += h * h * y_bar;
    if (forces != nullptr) Eigen::Map<Vec3>(forces + 3 * i) += h * h / m * y_bar;
    masses[i] += p.inertia.metric_bar[i] -
                 h * h / (m * m) * y_bar.dot(row(p.inputs.data(Input::kForces), v));
  }
}

void Cotangents::write(Problem& p, const Gradients& gradients) {
  for (const auto& potential : p.potentials) potential->pull_back(p, *this, gradients);
  pull_back_lumped(p, Input::kDensity, masses, p.density, *this, gradients);
  if (double* out = gradients[Input::kPositions]) {
    for (std::size_t a = 0; a < p.cloth_size; ++a) out[a] += start[a];
  }
  add_to(gradients[Input::kVelocities], velocities);
  if (double* out = gradients[Input::kPinTargets]) {
    for (const Index i : p.scene.given.pins) {
      for (Index a = 3 * i; a < 3 * i + 3; ++a) *out++ += ends[a];
    }
  }
  write_surfaces(p, *this, gradients);
  for (const PullBack& pull_back : of_stages) pull_back(gradients);
  write_rest(p, *this, gradients);
}

}  // namespace diffcloth::step
