#include <algorithm>
#include <numeric>

#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {

StoredEnergy stored_energy(const Scene& scene, const Inputs& inputs) {
  Problem p(scene, inputs);
  const double* x = p.start.data();
  StoredEnergy energy{
      .stretch = elastic::stretch_energy(p.model, x),
      .bending = elastic::bending_energy(p.model, x),
  };
  if (p.anchors) energy.soft_pins = p.anchors->energy(x);
  if (p.contact) {
    contact::BroadPhase::Scratch scratch;
    std::vector<contact::Candidate> candidates;
    scene.broad_phase.find(x, x, p.contact->reach(), scratch, candidates);
    contact::Near near;
    p.contact->measure(candidates, x, near);
    energy.contact = near.energy();
  }
  return energy;
}

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

/// kappa = c d_hat mean(H_ii) / (eta w_mean), c = 5; eta = d_hat b''(gap) at a gap of d_hat / 2.
double stiffness_for_cloths(const Scene& scene, const Inputs& inputs, double barrier_distance) {
  constexpr double kFactor = 5.0;
  Inputs at_rest = inputs;
  at_rest.views[static_cast<std::size_t>(Input::kPositions)].data =
      scene.given.rest_vertices.data();
  Problem p(scene, at_rest);
  std::vector<double> x = p.start;  // bodies, too
  std::copy_n(scene.given.rest_vertices.data(), p.cloth_size, x.begin());
  const linalg::BlockMatrix hessian = contact_free_hessian(p, x.data(), Curvature::kExact);
  const linalg::BlockPattern& pattern = hessian.pattern();
  const Index n = scene.cloth_vertex_count();
  double trace = 0.0;
  for (Index i = 0; i < n; ++i) {
    trace += Eigen::Map<const Mat3>(hessian.blocks() +
                                    9 * static_cast<std::ptrdiff_t>(pattern.column_start()[i]))
                 .trace();
  }
  const double mean_diagonal = trace / (3.0 * n);
  const std::vector<double>& area = p.rest->vertex_area;
  const double mean_weight =
      0.25 * std::accumulate(area.begin(), area.end(), 0.0) / static_cast<double>(area.size());

  double xi = 0.0;
  const double* thickness = inputs.data(Input::kThickness);
  for (Index c = 0; c < scene.cloth_count(); ++c) xi = std::max(xi, thickness[c]);
  const double eta = barrier_distance * at_half_gap(xi, barrier_distance).stiffness;
  return kFactor * barrier_distance * mean_diagonal / (eta * mean_weight);
}

/// Mass that a contact with a tree feels [kg]: all of a free root's; of joints the most that one of
/// them, with its drive, has at the farthest point that it moves. Zero where forces move nothing.
///
/// @param metric  the tree's block of A, [n_t^2]
/// @param first   the tree's first coordinate; it has `count` of them
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

/// kappa at which the heaviest tree, resting on one of six sides, stays d_hat / 2 away. Without gravity,
/// where it crosses the gap from rest in a time step.
///
/// @param with_joints  whether trees count whose roots are prescribed
double stiffness_for_bodies(const Scene& scene,
                            const Inputs& inputs,
                            double barrier_distance,
                            bool with_joints) {
  const bodies::MechanismsDescription& given = scene.mechanisms.given();
  const double* metric = inputs.data(Input::kCoordinateMetric);
  const double h = scene.given.dt;
  const double gravity = row(inputs.data(Input::kGravity), 0).norm();
  const double acceleration = gravity > 0.0 ? gravity : barrier_distance / (h * h);
  double result = 0.0;
  Index first = 0;
  for (std::size_t t = 0; t < given.tree_free.size(); ++t) {
    const auto n =
        static_cast<Index>(std::ranges::count(given.coordinate_tree, static_cast<Index>(t)));
    if (given.tree_free[t] != 0 || with_joints) {
      double area = 0.0;
      double xi = 0.0;
      for (Index v = scene.cloth_vertex_count(); v < scene.vertex_count(); ++v) {
        const Index surface = scene.collision_mesh.vertex_surface[v];
        if (given.links[given.surface_link[surface - scene.cloth_count()]].tree !=
            static_cast<Index>(t)) {
          continue;
        }
        area += scene.measures.vertex_area[v];
        xi = std::max(xi, inputs.data(Input::kThickness)[surface]);
      }
      const double weight = 0.25 * area / 6.0;
      const double slope = at_half_gap(xi, barrier_distance).slope;
      const double mass = felt_mass(scene, metric, first, n);
      if (weight > 0.0) result = std::max(result, mass * acceleration / (weight * slope));
    }
    metric += static_cast<std::ptrdiff_t>(n) * n;
    first += n;
  }
  return result;
}

/// Gap at which the barrier pushes with a pressure, halved until float64 has no more of it [m].
double gap_under(double pressure, double kappa, double xi, double barrier_distance) {
  double low = 0.0;
  double high = barrier_distance;
  constexpr int kHalvings = 60;
  for (int i = 0; i < kHalvings; ++i) {
    const double gap = 0.5 * (low + high);
    const double d = xi + gap;
    const double slope = -2.0 * d * contact::barrier_derivatives(d * d, xi, barrier_distance).b1;
    // A vertex's weight is a quarter of its area, as in the stiffness above.
    (0.25 * kappa * slope > pressure ? low : high) = gap;
  }
  return high;
}

}  // namespace

std::optional<CloseStart> find_close_start(const Scene& scene, const Inputs& inputs) {
  const double* kappa = inputs.data(Input::kBarrierStiffness);
  if (kappa == nullptr || scene.cloth_count() == 0) return {};
  const double reach = inputs.data(Input::kBarrierDistance)[0];
  const double* first = inputs.data(Input::kThickness);
  const std::vector<double> thickness(first, first + scene.surface_count());
  const Problem problem(scene, inputs);
  contact::BroadPhase::Scratch scratch;
  const double* const x = problem.start.data();
  const auto candidates = find_near(scene, x, thickness, reach, scratch);
  const auto closest = find_closest(scene, x, thickness, reach, candidates);
  if (!closest) return {};
  const double gravity = row(inputs.data(Input::kGravity), 0).norm();
  const double pressure = std::ranges::max(problem.density) * gravity;
  return CloseStart{
      .elements = describe_pair(scene, closest->pair),
      .gap = closest->distance - closest->thickness,
      .rest_gap = gap_under(pressure, *kappa, closest->thickness, reach),
  };
}

double default_barrier_stiffness(const Scene& scene,
                                 const Inputs& inputs,
                                 double barrier_distance) {
  double kappa = 0.0;
  if (scene.cloth_count() > 0) kappa = stiffness_for_cloths(scene, inputs, barrier_distance);
  if (scene.mechanisms.has_free()) {
    kappa = std::max(kappa, stiffness_for_bodies(scene, inputs, barrier_distance, false));
    // Where nothing else gives a scale, joints do.
    if (kappa == 0.0) kappa = stiffness_for_bodies(scene, inputs, barrier_distance, true);
  }
  return kappa;
}

}  // namespace diffcloth::step
