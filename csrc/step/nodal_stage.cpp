#include "step/nodal_stage.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "projective/anderson.h"
#include "step/nodal_system.h"

namespace diffcloth::step {
namespace {

/// Local/global iterations that do not halve the residual, after which they are given up: near a saddle
/// it must grow on the way down, which they do not follow.
constexpr int kIdle = 100;

}  // namespace

using Array = std::vector<double>;
using projective::ContactCase;
using projective::Coulomb;
using projective::NodalContact;

solver::Objective NodalStage::objective() const {
  std::vector<Potential*> others = problem_.elastic_potentials();
  if (contacts_.couplings) others.push_back(contacts_.couplings.get());
  return problem_.objective(problem_.inertia, std::move(others), problem_.scene.elastic_assemblies);
}

void NodalStage::start(Array& x) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  for (const NodalContact& c : contacts_.list) {
    const Vec3 u = system.velocity(c, x);
    const double m = system.rho(c);
    const Vec3 r = projective::coulomb(-m * u, c.normal, c.friction).impulse;
    spread(c, problem_.h * scale(c) / m * r, x.data());
  }
  // Where that would collapse the cloth, where it stands is the better place to begin.
  Array held = problem_.predicted(problem_.start.data());
  system.clear_approach(held);
  if (f.energy_change(x.data(), held.data()) < 0.0) x = std::move(held);
}

projective::Outcome NodalStage::iterate(const projective::Objective& smooth,
                                        const projective::Options& options,
                                        const Checkpoint& checkpoint,
                                        Array& x) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  projective::ConstantMatrix::Scratch scratch;
  projective::Anderson anderson(problem_.cloth_size);
  projective::Outcome outcome;
  Array g(problem_.cloth_size);
  Array force(problem_.cloth_size);
  Array p(problem_.cloth_size);
  Array q(problem_.cloth_size);
  Array plain(problem_.cloth_size);  // where the last iteration leads without acceleration
  Array to = x;
  double last = std::numeric_limits<double>::infinity();
  double best = std::numeric_limits<double>::infinity();
  int idle = 0;
  bool accelerated = false;
  for (;; ++outcome.iterations) {
    checkpoint.check();
    smooth.gradient(x, g);
    force = g;
    for (const NodalContact& c : contacts_.list) {
      const double h_s = problem_.h * scale(c);
      const Vec3 r = h_s * relative(c, g.data());
      // With the true masses for rho the iteration contracts wherever the cloth is taut.
      const Vec3 s = r - reduced(problem_.masses, c) * system.velocity(c, x);
      spread(c, -projective::coulomb(s, c.normal, c.friction).impulse / h_s, force.data());
    }
    outcome.residual = smooth.largest_rate(force);
    if (!std::isfinite(outcome.residual)) {
      outcome.status = projective::Status::kOverflow;
      return outcome;
    }
    if (outcome.residual < options.tolerance) {
      outcome.status = projective::Status::kConverged;
      return outcome;
    }
    if (outcome.iterations == options.max_iterations) return outcome;
    ++idle;
    if (outcome.residual < 0.5 * best) {
      best = outcome.residual;
      idle = 0;
    }
    if (idle == kIdle) {
      outcome.status = projective::Status::kStalled;
      return outcome;
    }
    smooth.matrix->solve(force.data(), p.data(), scratch);
    double size = 0.0;
    for (std::size_t a = 0; a < p.size(); ++a) {
      p[a] = -p[a];
      q[a] = -force[a];
      size += p[a] * q[a];
    }
    if (accelerated && size > last) {
      // Acceleration has led astray: go on from where the plain iteration leads.
      anderson = projective::Anderson(problem_.cloth_size);
      std::ranges::copy(plain, x.begin());
      accelerated = false;
      continue;
    }
    last = size;
    for (std::size_t a = 0; a < p.size(); ++a) plain[a] = x[a] + p[a];
    anderson.next(x.data(), p.data(), q.data(), to.data());
    x.swap(to);
    accelerated = true;
  }
}

void NodalStage::finish(const Array& x, Report& report, double* body_forces) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  for (std::size_t k = 0; k < contacts_.list.size(); ++k) {
    const NodalContact& c = contacts_.list[k];
    switch (at.laws[k].kind) {
      case ContactCase::kTakingOff:
        ++report.taking_off;
        continue;
      case ContactCase::kSticking:
        ++report.sticking;
        break;
      case ContactCase::kSlipping:
        ++report.slipping;
        break;
    }
    if (c.obstacle < 0) continue;
    const Index body = contacts_.obstacles[c.obstacle].body;
    const auto share = problem_.scene.face_search[body].share(c.surface_point);
    const Vec3 force = relative(c, at.g.data());
    for (int a = 0; a < 3; ++a) {
      Eigen::Map<Vec3>(body_forces + 3 * share.corners[a]) -= share.weights[a] * force;
    }
  }
}

}  // namespace diffcloth::step
