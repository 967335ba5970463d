#include <numeric>

#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {

double potential_energy(const Scene& scene, const Inputs& inputs) {
  Problem p(scene, inputs);
  const double* x = p.start.data();
  double energy = 0.0;
  for (const Potential* potential : p.elastic_potentials()) energy += potential->energy(x);
  const Vec3 gravity = row(inputs.data(Input::kGravity), 0);
  for (std::size_t i = 0; i < p.masses.size(); ++i) {
    energy -= p.masses[i] * gravity.dot(row(x, static_cast<Index>(i)));
  }
  if (p.contact) {
    contact::BroadPhase::Scratch scratch;
    std::vector<contact::Candidate> candidates;
    scene.broad_phase.find(x, x, p.contact->reach(), scratch, candidates);
    std::vector<double> energies;
    p.contact->energies(candidates, x, energies);
    energy = std::accumulate(energies.begin(), energies.end(), energy);
  }
  return energy;
}

double default_barrier_stiffness(const Scene& scene,
                                 const Inputs& inputs,
                                 double barrier_distance) {
  // kappa = c d_hat mean(H_ii) / (eta w_mean), c = 5; eta = d_hat b''(gap) at a gap of d_hat / 2,
  // with derivatives with respect to the gap: b''_gap = 4 d^2 b'' + 2 b' at d = xi + gap.
  constexpr double kFactor = 5.0;
  Inputs at_rest = inputs;
  at_rest.views[static_cast<std::size_t>(Input::kPositions)].data =
      scene.given.rest_vertices.data();
  Problem p(scene, at_rest);
  const linalg::BlockMatrix hessian =
      contact_free_hessian(p, scene.given.rest_vertices.data(), Curvature::kExact);
  const linalg::BlockPattern& pattern = hessian.pattern();
  double trace = 0.0;
  for (Index i = 0; i < pattern.size(); ++i) {
    trace += Eigen::Map<const Mat3>(hessian.blocks() +
                                    9 * static_cast<std::ptrdiff_t>(pattern.column_start()[i]))
                 .trace();
  }
  const double mean_diagonal = trace / (3.0 * pattern.size());
  const std::vector<double>& area = p.rest->vertex_area;
  const double mean_weight =
      0.25 * std::accumulate(area.begin(), area.end(), 0.0) / static_cast<double>(area.size());

  double xi = 0.0;
  const double* thickness = inputs.data(Input::kThickness);
  for (Index c = 0; c < scene.cloth_count(); ++c) xi = std::max(xi, thickness[c]);
  const double d = xi + 0.5 * barrier_distance;
  const contact::Barrier b = contact::barrier_derivatives(d * d, xi, barrier_distance);
  const double eta = barrier_distance * (4.0 * d * d * b.b2 + 2.0 * b.b1);
  return kFactor * barrier_distance * mean_diagonal / (eta * mean_weight);
}

}  // namespace diffcloth::step
