#include "step/tangents.h"

#include <algorithm>
#include <array>

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Change of the vertices of bodies, and of the frames, due to the poses of all roots.
void move_roots(const Problem& p, Input input, const double* change, Array& points) {
  if (change == nullptr) return;
  const double* const poses = p.inputs.data(input);
  p.scene.given.bodies.place_jvp(poses, change, points.data() + p.cloth_size);
  p.scene.mechanisms.set_frames_jvp(poses, change, p.coordinates.nodes(points));
}

Array start_tangent(const Problem& p, const Inputs& directions) {
  Array change(p.start.size(), 0.0);
  if (const double* x = directions.data(Input::kPositions)) {
    std::copy_n(x, p.cloth_size, change.begin());
  }
  move_roots(p, Input::kBodyPoses, directions.data(Input::kBodyPoses), change);
  const bodies::Mechanisms& mechanisms = p.scene.mechanisms;
  if (const double* q = directions.data(Input::kCoordinates)) {
    for (Index c = 0; c < mechanisms.coordinate_count(); ++c) {
      p.coordinates.nodes(change)[mechanisms.slot(c)] = q[c];
    }
  }
  p.coordinates.carry(p.start, change);
  return change;
}

Array origins_tangent(const Problem& p, const Inputs& directions, Array start) {
  if (p.origins.empty()) return {};
  const std::size_t count = p.inputs[Input::kFrictionOrigins].count;
  std::fill_n(start.begin(), count, 0.0);
  if (const double* origins = directions.data(Input::kFrictionOrigins)) {
    std::copy_n(origins, count, start.begin());
  }
  return start;
}

Array ends_tangent(const Problem& p, const Inputs& directions) {
  Array change(p.start.size(), 0.0);
  move_roots(p, Input::kBodyTargets, directions.data(Input::kBodyTargets), change);
  const bodies::Mechanisms& mechanisms = p.scene.mechanisms;
  if (const double* q = directions.data(Input::kCoordinateEnds)) {
    for (Index c = 0; c < mechanisms.coordinate_count(); ++c) {
      if (mechanisms.given().prescribed[c] == 0) continue;
      p.coordinates.nodes(change)[mechanisms.slot(c)] = q[c];
    }
  }
  if (const double* targets = directions.data(Input::kPinTargets)) {
    for (const Index i : p.scene.given.pins) {
      for (Index a = 3 * i; a < 3 * i + 3; ++a) change[a] = *targets++;
    }
  }
  return change;
}

mesh::RestShapeBar rest_tangent(const Problem& p, const Inputs& directions) {
  const double* const change = directions.data(Input::kRestPositions);
  if (change == nullptr) return {};
  const double* const X = p.inputs.data(Input::kRestPositions);
  return mesh::rest_shape_jvp(p.scene.topology, p.scene.stencils,
                              X != nullptr ? X : p.scene.given.rest_positions.data(), change);
}

/// y = xhat = x_n + h v_n + h^2 (gravity + f / m).
Array predicted(const Problem& p, const Tangents& tangents) {
  const Inputs& directions = tangents.directions;
  const double* const v = directions.data(Input::kVelocities);
  const double* const gravity = directions.data(Input::kGravity);
  const double* const f = directions.data(Input::kForces);
  const double h = p.h;
  Array result(tangents.start.begin(),
               tangents.start.begin() + static_cast<std::ptrdiff_t>(p.cloth_size));
  for (std::size_t i = 0; i < p.masses.size(); ++i) {
    const auto vertex = static_cast<Index>(i);
    const double m = p.masses[i];
    Eigen::Map<Vec3> y(result.data() + 3 * i);
    if (v != nullptr) y += h * row(v, vertex);
    if (gravity != nullptr) y += h * h * row(gravity, 0);
    if (f != nullptr) y += h * h / m * row(f, vertex);
    y -= h * h / (m * m) * tangents.masses[i] * row(p.inputs.data(Input::kForces), vertex);
  }
  return result;
}

/// Inputs of barrier and friction besides points and the rest shape.
constexpr std::array kOfContact = {Input::kBarrierDistance, Input::kSlipVelocity, Input::kThickness,
                                   Input::kBarrierStiffness, Input::kFriction};

/// Copy the tangent of an input with one value for all pairs of surfaces, or one for each pair.
void copy_pairs(const Problem& p, const Inputs& directions, Input input, Array& out) {
  const double* const change = directions.data(input);
  if (change == nullptr) return;
  const bool one = p.inputs[input].count == 1;
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = change[one ? 0 : k];
}

/// Tangents of the parameters of barrier and friction, the rest shape of the cloths included.
void fill_contact(const Problem& p, const Tangents& tangents, contact::ContactModel::Bar& out) {
  const Inputs& directions = tangents.directions;
  if (const double* d_hat = directions.data(Input::kBarrierDistance)) out.d_hat = *d_hat;
  if (const double* slip = directions.data(Input::kSlipVelocity)) out.slip = p.h * *slip;
  if (const double* thickness = directions.data(Input::kThickness)) {
    std::copy_n(thickness, out.thickness.size(), out.thickness.begin());
  }
  copy_pairs(p, directions, Input::kBarrierStiffness, out.kappa);
  copy_pairs(p, directions, Input::kFriction, out.friction);
  const mesh::RestShapeBar& rest = tangents.rest;
  if (rest.area.empty()) return;
  const std::vector<Index>& start = p.scene.given.cloth_face_start;
  for (Index c = 0; c < p.scene.cloth_count(); ++c) {
    double sum = 0.0;
    for (Index f = start[c]; f < start[c + 1]; ++f) sum += rest.area[f];
    out.rest.mean_face_area[c] = sum / (start[c + 1] - start[c]);
  }
  std::ranges::copy(rest.area, out.rest.face_area.begin());
  std::ranges::copy(rest.vertex_area, out.rest.vertex_area.begin());
  std::ranges::copy(rest.edge_area, out.rest.edge_area.begin());
  std::ranges::copy(rest.edge_length_sq, out.rest.edge_length_sq.begin());
}

}  // namespace

Tangents::Tangents(const Problem& p, const Inputs& directions_in)
    : directions(directions_in),
      start(start_tangent(p, directions)),
      origins(origins_tangent(p, directions, start)),
      ends(ends_tangent(p, directions)),
      contact(p.scene.collision_mesh),
      rest(rest_tangent(p, directions)) {
  masses = lumped(p, Input::kDensity, p.density);
  prediction = predicted(p, *this);
  fill_contact(p, *this, contact);
  changes_contact = !rest.area.empty() || std::ranges::any_of(kOfContact, [&](Input input) {
    return directions.data(input) != nullptr;
  });
}

void Tangents::push_forward(Problem& p) const {
  p.inertia.metric_dot = masses;
  p.inertia.target_dot = prediction;
  for (const auto& potential : p.potentials) potential->push_forward(p, *this);
  if (!p.chart) return;
  const auto copy = [&](Input input) {
    const double* const change = directions.data(input);
    const std::size_t count = p.inputs[input].count;
    return change != nullptr ? Array(change, change + count) : Array(count, 0.0);
  };
  p.chart->target_dot = copy(Input::kCoordinateTargets);
  p.chart->metric_dot = copy(Input::kCoordinateMetric);
  p.chart->joint_dot = copy(Input::kJointTerms);
}

Array Tangents::per_face(const Problem& p, Input input) const {
  const std::vector<Index>& owner = p.scene.face_cloth;
  Array result(owner.size(), 0.0);
  const View& change = directions[input];
  if (change.data == nullptr) return result;
  for (std::size_t f = 0; f < owner.size(); ++f) {
    result[f] = change.data[change.count == 1              ? 0
                            : change.count == owner.size() ? f
                                                           : static_cast<std::size_t>(owner[f])];
  }
  return result;
}

Array Tangents::lumped(const Problem& p, Input input, const Array& values) const {
  Array result(p.masses.size(), 0.0);
  if (directions.data(input) == nullptr && rest.area.empty()) return result;
  Array change = per_face(p, input);
  for (std::size_t f = 0; f < change.size(); ++f) {
    change[f] *= p.rest->area[f];
    if (!rest.area.empty()) change[f] += values[f] * rest.area[f];
  }
  for (std::size_t f = 0; f < change.size(); ++f) {
    for (const Index i : p.scene.topology.faces[f]) result[i] += change[f] / 3.0;
  }
  return result;
}

}  // namespace diffcloth::step
