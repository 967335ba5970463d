#include "step/cotangents.h"

#include <algorithm>
#include <utility>

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

void add_to(double* out, const Array& bar) {
  if (out == nullptr) return;
  for (std::size_t a = 0; a < bar.size(); ++a) out[a] += bar[a];
}

/// Like add_to(), of an input that has one value for all pairs of surfaces, or one for each.
void add_pairs_to(double* out, const View& input, const Array& bar) {
  if (out == nullptr) return;
  for (std::size_t k = 0; k < bar.size(); ++k) out[input.count == 1 ? 0 : k] += bar[k];
}

void write_surfaces(const Problem& p, const Cotangents& bars, const Gradients& gradients) {
  const bodies::BodySet& bodies = p.scene.given.bodies;
  const bodies::Mechanisms& mechanisms = p.scene.mechanisms;
  Array start = bars.start;
  p.coordinates.gather(p.start, start);
  if (!bars.origins.empty()) {
    Array origins = bars.origins;
    p.coordinates.gather(p.origins, origins);
    for (Index c = 0; c < mechanisms.coordinate_count(); ++c) {
      double& bar = p.coordinates.nodes(origins)[mechanisms.slot(c)];
      if (double* out = gradients[Input::kCoordinateOrigins]) out[c] += bar;
      bar = 0.0;
    }
    // Frames, and bodies without coordinates, are where they start.
    for (std::size_t a = 0; a < start.size(); ++a) start[a] += origins[a];
  }
  if (double* out = gradients[Input::kBodyPoses]) {
    const double* poses = p.inputs.data(Input::kBodyPoses);
    bodies.place_vjp(poses, start.data() + p.cloth_size, out);
    add_to(out, bars.body_poses);
    mechanisms.set_frames_vjp(poses, p.coordinates.nodes(start), out);
  }
  if (double* out = gradients[Input::kBodyTargets]) {
    const double* poses = p.inputs.data(Input::kBodyTargets);
    bodies.place_vjp(poses, bars.ends.data() + p.cloth_size, out);
    add_to(out, bars.body_targets);
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
  }
  if (double* out = gradients[Input::kBarrierDistance]) *out += bars.contact.d_hat;
  if (double* out = gradients[Input::kSlipVelocity]) *out += p.h * bars.contact.slip;
  add_to(gradients[Input::kThickness], bars.contact.thickness);
  add_pairs_to(gradients[Input::kBarrierStiffness], p.inputs[Input::kBarrierStiffness],
               bars.contact.kappa);
  add_pairs_to(gradients[Input::kFriction], p.inputs[Input::kFriction], bars.contact.friction);
}

/// Sum over the corners of each face of their masses' cotangents.
Array face_sums(const Problem& p, const Array& masses) {
  const auto& faces = p.scene.topology.faces;
  Array sums(faces.size(), 0.0);
  for (std::size_t f = 0; f < faces.size(); ++f) {
    for (const Index i : faces[f]) sums[f] += masses[i];
  }
  return sums;
}

void write_materials(Problem& p, const Cotangents& bars, const Gradients& gradients) {
  const auto write_per_face = [&](Input input, const Array& bar) {
    if (gradients[input] == nullptr) return;
    gather(bar, p.scene.face_cloth, p.inputs[input], gradients[input]);
  };
  const elastic::Bar& elastic = p.elasticity.bar();
  write_per_face(Input::kStretch, elastic.stretch);
  write_per_face(Input::kBending, elastic.bending);
  write_per_face(Input::kPoisson, elastic.poisson);
  write_per_face(Input::kDamping, elastic.damping);

  Array density_bar = face_sums(p, bars.masses);
  for (std::size_t f = 0; f < density_bar.size(); ++f) density_bar[f] *= p.rest->area[f] / 3.0;
  write_per_face(Input::kDensity, density_bar);

  if (!p.anchors) return;
  add_to(gradients[Input::kSoftPinTargets], p.anchors->target_bar);
  if (double* out = gradients[Input::kPinStiffness]) {
    const bool one = p.inputs[Input::kPinStiffness].count == 1;
    const std::vector<Index>& soft = p.scene.given.soft_pins;
    for (std::size_t k = 0; k < soft.size(); ++k) {
      out[one ? 0 : p.scene.vertex_cloth[soft[k]]] += p.anchors->stiffness_bar[k];
    }
  }
}

/// The rest shape acts through elasticity, masses and the contacts' weights and mollifiers.
void write_rest(Problem& p, const Cotangents& bars, const Gradients& gradients) {
  double* out = gradients[Input::kRestPositions];
  if (out == nullptr) return;
  mesh::RestShapeBar& rest = p.elasticity.bar().rest;
  const Array sums = face_sums(p, bars.masses);
  for (std::size_t f = 0; f < sums.size(); ++f) {
    rest.area[f] += sums[f] * p.density[f] / 3.0;
  }
  const std::vector<Index>& start = p.scene.given.cloth_face_start;
  for (Index c = 0; c < p.scene.cloth_count(); ++c) {
    const double share = bars.contact.rest.mean_face_area[c] / (start[c + 1] - start[c]);
    for (Index f = start[c]; f < start[c + 1]; ++f) rest.area[f] += share;
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
                       X != nullptr ? X : p.scene.given.rest_vertices.data(), rest, out);
}

}  // namespace

Cotangents::Cotangents(const Problem& p)
    : start(p.start.size(), 0.0),
      origins(p.origins.size(), 0.0),
      ends(p.start.size(), 0.0),
      velocities(p.cloth_size, 0.0),
      masses(p.masses.size(), 0.0),
      body_poses(p.inputs[Input::kBodyPoses].count, 0.0),
      body_targets(p.inputs[Input::kBodyTargets].count, 0.0),
      contact(p.scene.collision_mesh),
      metric_(p.inertia.metric_bar.size(), 0.0),
      target_(p.inertia.target_bar.size(), 0.0) {
  if (p.anchors) {
    anchor_stiffness_.assign(p.anchors->stiffness_bar.size(), 0.0);
    anchor_target_.assign(p.anchors->target_bar.size(), 0.0);
  }
  if (p.chart) {
    chart_target_.assign(p.chart->target_bar.size(), 0.0);
    chart_metric_.assign(p.chart->metric_bar.size(), 0.0);
  }
}

void Cotangents::exchange(Problem& p) {
  std::swap(p.inertia.metric_bar, metric_);
  std::swap(p.inertia.target_bar, target_);
  p.elasticity.exchange(elastic_);
  if (p.anchors) {
    std::swap(p.anchors->stiffness_bar, anchor_stiffness_);
    std::swap(p.anchors->target_bar, anchor_target_);
  }
  if (p.chart) {
    std::swap(p.chart->target_bar, chart_target_);
    std::swap(p.chart->metric_bar, chart_metric_);
  }
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
  const Array& damping_bar = p.elasticity.bar().x_n;
  if (double* out = gradients[Input::kPositions]) {
    for (std::size_t a = 0; a < damping_bar.size(); ++a) out[a] += start[a] + damping_bar[a];
  }
  add_to(gradients[Input::kVelocities], velocities);
  if (double* out = gradients[Input::kPinTargets]) {
    for (const Index i : p.scene.given.pins) {
      for (Index a = 3 * i; a < 3 * i + 3; ++a) *out++ += ends[a];
    }
  }
  write_surfaces(p, *this, gradients);
  write_materials(p, *this, gradients);
  write_rest(p, *this, gradients);
}

}  // namespace diffcloth::step
