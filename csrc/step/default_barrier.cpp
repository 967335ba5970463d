#include <algorithm>
#include <cmath>

#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {
namespace {

/// Slope -b' and stiffness b'' of the barrier of unit weight in the gap, half of d_hat wide.
struct HalfGap {
  double slope;
  double stiffness;
};

HalfGap at_half_gap(double xi, double barrier_distance) {
  const double d = xi + 0.5 * barrier_distance;
  const contact::Barrier b = contact::barrier_derivatives(d * d, xi, barrier_distance);
  return {.slope = -2.0 * d * b.b1, .stiffness = 4.0 * d * d * b.b2 + 2.0 * b.b1};
}

/// Remove springs with a rest length from the weights; return the traces that they would add to the
/// Hessian of each vertex with a rest length of zero. Their Hessian depends on the positions of their
/// ends, which the rest positions of several cloths do not determine; for springs shorter than at rest
/// it is not even positive definite.
std::vector<double> take_out_long_springs(const Scene& scene,
                                          const Inputs& inputs,
                                          std::vector<double>& weights) {
  const AttachmentDescription& springs = scene.given.attachments;
  std::vector<double> traces(scene.cloth_vertex_count(), 0.0);
  for (std::size_t a = 0; a < weights.size(); ++a) {
    if (springs.rest_length[a] == 0.0) continue;
    const double k = weights[a] * inputs.data(Input::kSpringStiffness)[a];
    weights[a] = 0.0;
    for (Index e = springs.start[a]; e < springs.start[a + 1]; ++e) {
      const double c = springs.coefficient[e];
      if (springs.point[e] < scene.cloth_vertex_count())
        traces[springs.point[e]] += 3.0 * k * c * c;
    }
  }
  return traces;
}

/// Rest positions with which the cloths' embedding is at rest, also at seams [3 M].
std::vector<double> rest_positions_of_embedding(const Scene& scene) {
  std::vector<double> X(scene.given.rest_positions.size());
  const mesh::Topology& topology = scene.topology;
  for (std::size_t f = 0; f < topology.faces.size(); ++f) {
    for (int p = 0; p < 3; ++p) {
      Eigen::Map<Vec3>(X.data() + 3 * topology.rest_faces[f][p]) =
          row(scene.given.rest_embedding.data(), topology.faces[f][p]);
    }
  }
  return X;
}

/// kappa = c d_hat mean(H_ii) / (eta w_mean) of each cloth, c = 5; eta = d_hat b''(gap) at a gap of
/// d_hat / 2 between surfaces as thick as the cloth.
std::vector<double> stiffness_of_cloths(const Scene& scene,
                                        const Inputs& inputs,
                                        double barrier_distance) {
  constexpr double kFactor = 5.0;
  std::vector<double> result;
  if (scene.cloth_count() == 0) return result;
  Inputs at_rest = inputs;
  const std::vector<double>& embedding = scene.given.rest_embedding;
  at_rest.views[static_cast<std::size_t>(Input::kPositions)].data = embedding.data();
  std::vector<double> X;
  if (embedding != scene.given.rest_positions) {
    X = rest_positions_of_embedding(scene);
    at_rest.views[static_cast<std::size_t>(Input::kRestPositions)] = {.data = X.data(),
                                                                      .count = X.size()};
  }
  const double* const given_weights = inputs.data(Input::kSpringWeights);
  std::vector<double> weights(given_weights,
                              given_weights + scene.given.attachments.rest_length.size());
  const std::vector<double> of_springs = take_out_long_springs(scene, inputs, weights);
  if (!weights.empty())
    at_rest.views[static_cast<std::size_t>(Input::kSpringWeights)].data = weights.data();
  Problem p(scene, at_rest);
  std::vector<double> x = p.start;  // bodies included
  std::copy_n(embedding.data(), p.cloth_size, x.begin());
  const linalg::BlockMatrix hessian = contact_free_hessian(p, x.data(), Curvature::kExact);
  const linalg::BlockPattern& pattern = hessian.pattern();
  const double* thickness = inputs.data(Input::kThickness);
  const std::vector<Index>& start = scene.given.cloth_vertex_start;
  for (Index c = 0; c < scene.cloth_count(); ++c) {
    double trace = 0.0;
    double area = 0.0;
    for (Index i = start[c]; i < start[c + 1]; ++i) {
      trace += Eigen::Map<const Mat3>(hessian.blocks() +
                                      9 * static_cast<std::ptrdiff_t>(pattern.column_start()[i]))
                   .trace() +
               of_springs[i];
      area += p.rest->vertex_area[i];
    }
    const Index n = start[c + 1] - start[c];
    const double mean_diagonal = trace / (3.0 * n);
    const double mean_weight = 0.25 * area / n;
    const double eta = barrier_distance * at_half_gap(thickness[c], barrier_distance).stiffness;
    result.push_back(kFactor * barrier_distance * mean_diagonal / (eta * mean_weight));
  }
  return result;
}

/// The tree that moves a surface of a body or link.
std::size_t tree_of(const Scene& scene, Index surface) {
  const bodies::MechanismsDescription& given = scene.mechanisms.given();
  return static_cast<std::size_t>(
      given.links[given.surface_link[surface - scene.cloth_count()]].tree);
}

/// Mass that a contact with a tree feels [kg]: the whole mass of a free root; for joints, the largest
/// mass of a joint and its drive at the farthest point that the joint moves. Zero if nothing is dynamic.
///
/// @param metric  the tree's block of A, [n_t^2]
/// @param first   first of the tree's `count` coordinates
double felt_mass(const Scene& scene, const double* metric, Index first, Index count) {
  const bodies::MechanismsDescription& given = scene.mechanisms.given();
  const double h = scene.given.dt;
  if (count > 0 && given.tree_free[given.coordinate_tree[first]] != 0) return metric[0] * h * h;
  double result = 0.0;
  for (Index k = 0; k < count; ++k) {
    if (given.prescribed[first + k] != 0) continue;
    const double lever = scene.mechanisms.lever()[scene.mechanisms.slot(first + k)];
    const std::ptrdiff_t diagonal = static_cast<std::ptrdiff_t>(k) * (count + 1);
    result = std::max(result, metric[diagonal] * h * h / (lever * lever));
  }
  return result;
}

/// kappa at which each tree, resting on one of six sides, stays d_hat / 2 away; without gravity, at
/// which it crosses the gap from rest in a time step. Zero for trees that no force moves.
std::vector<double> stiffness_of_trees(const Scene& scene,
                                       const Inputs& inputs,
                                       double barrier_distance) {
  const bodies::MechanismsDescription& given = scene.mechanisms.given();
  std::vector<double> result(given.tree_free.size(), 0.0);
  if (!scene.mechanisms.has_free()) return result;
  const double* metric = inputs.data(Input::kCoordinateMetric);
  const double h = scene.given.dt;
  const double gravity = row(inputs.data(Input::kGravity), 0).norm();
  const double acceleration = gravity > 0.0 ? gravity : barrier_distance / (h * h);
  Index first = 0;
  for (std::size_t t = 0; t < result.size(); ++t) {
    const auto n =
        static_cast<Index>(std::ranges::count(given.coordinate_tree, static_cast<Index>(t)));
    double area = 0.0;
    double xi = 0.0;
    for (Index v = scene.cloth_vertex_count(); v < scene.vertex_count(); ++v) {
      const Index surface = scene.collision_mesh.vertex_surface[v];
      if (tree_of(scene, surface) != t) continue;
      area += scene.measures.vertex_area[v];
      xi = std::max(xi, inputs.data(Input::kThickness)[surface]);
    }
    const double weight = 0.25 * area / 6.0;
    const double slope = at_half_gap(xi, barrier_distance).slope;
    const double mass = felt_mass(scene, metric, first, n);
    if (weight > 0.0) result[t] = mass * acceleration / (weight * slope);
    metric += static_cast<std::ptrdiff_t>(n) * n;
    first += n;
  }
  return result;
}

/// Factor on kappa for round surfaces: at half the gap the barrier is softer the larger xi is.
/// Compensates the radius of the surface for which kappa was chosen, or of the other one.
double for_radii(const Scene& scene, Index own, double xi, double radii, double barrier_distance) {
  if (radii == 0.0) return 1.0;
  const HalfGap without = at_half_gap(xi, barrier_distance);
  const HalfGap with = at_half_gap(xi + radii, barrier_distance);
  return own < scene.cloth_count() ? without.stiffness / with.stiffness
                                   : without.slope / with.slope;
}

}  // namespace

std::vector<double> default_barrier_stiffness(const Scene& scene,
                                              const Inputs& inputs,
                                              double barrier_distance) {
  const Index surfaces = scene.surface_count();
  // Stiffness required by cloths and free bodies; the requirement of joints counts only without either.
  std::vector<double> own = stiffness_of_cloths(scene, inputs, barrier_distance);
  std::vector<double> of_joints(own.size(), 0.0);
  const std::vector<double> of_trees = stiffness_of_trees(scene, inputs, barrier_distance);
  for (Index s = scene.cloth_count(); s < surfaces; ++s) {
    const std::size_t tree = tree_of(scene, s);
    const bool is_free = scene.mechanisms.given().tree_free[tree] != 0;
    own.push_back(is_free ? of_trees[tree] : 0.0);
    of_joints.push_back(is_free ? 0.0 : of_trees[tree]);
  }
  const std::vector<double>& radius = scene.collision_mesh.radius;
  const double* const thickness = inputs.data(Input::kThickness);
  std::vector<double> result;
  for (Index a = 0; a < surfaces; ++a) {
    for (Index b = 0; b < surfaces; ++b) {
      double kappa = 0.0;
      if (scene.collision_mesh.touching.contains(a, b)) {
        const double radii = radius[a] + radius[b];
        const double of_a = for_radii(scene, a, thickness[a], radii, barrier_distance);
        const double of_b = for_radii(scene, b, thickness[b], radii, barrier_distance);
        kappa = std::max(of_a * own[a], of_b * own[b]);
        if (kappa == 0.0) kappa = std::max(of_a * of_joints[a], of_b * of_joints[b]);
      }
      result.push_back(kappa);
    }
  }
  // Pairs that never touch need no stiffness of their own: any positive number serves, also if nothing
  // touches.
  const auto first = std::ranges::find_if(result, [](double kappa) { return kappa > 0.0; });
  std::ranges::replace(result, 0.0, first != result.end() ? double{*first} : 1.0);
  return result;
}

}  // namespace diffcloth::step
