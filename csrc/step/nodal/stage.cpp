#include "step/nodal/stage.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "projective/anderson.h"
#include "solver/stopping.h"
#include "step/nodal/system.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;
using projective::ContactCase;
using projective::NodalContact;

/// Detects stalled residuals: none has halved for a number of iterations.
class Progress {
 public:
  bool has_ended(double residual) {
    ++idle_;
    if (residual < 0.5 * best_) {
      best_ = residual;
      idle_ = 0;
    }
    return idle_ == solver::stopping::kLocalGlobal.stalled_iterations;
  }

 private:
  double best_ = std::numeric_limits<double>::infinity();
  int idle_ = 0;
};

/// Replace the gradient of the smooth potentials by the force that remains with the impulses.
void subtract_impulses(const Problem& problem,
                       const NodalContacts& contacts,
                       const NodalSystem& system,
                       const Array& x,
                       const Array& g,
                       Array& force) {
  for (const NodalContact& c : contacts.list) {
    const double h_s = problem.h * scale(c);
    const Vec3 r = h_s * relative(c, g.data());
    // With the true masses for rho the iteration contracts wherever the cloth is taut.
    const Vec3 s = r - reduced(problem.masses, c) * system.velocity(c, x);
    spread(c, -projective::coulomb(s, c.normal, c.friction).impulse / h_s, force.data());
  }
}

}  // namespace

solver::Objective NodalStage::objective() const {
  std::vector<Potential*> others = problem_.cloth_potentials();
  if (contacts_.couplings) others.push_back(contacts_.couplings.get());
  return problem_.objective(problem_.inertia, std::move(others), problem_.scene.elastic_patterns);
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
  // If these impulses would collapse the cloth, the held start is the better initial iterate.
  Array held = problem_.predicted(problem_.start.data());
  system.clear_approach(held);
  if (f.energy_change(x.data(), held.data()) < 0.0) x = std::move(held);
}

projective::LocalGlobalOutcome NodalStage::iterate(const projective::LocalGlobalObjective& smooth,
                                                   const projective::LocalGlobalOptions& options,
                                                   const Checkpoint& checkpoint,
                                                   Array& x) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  projective::ConstantMatrix::Scratch scratch;
  projective::Anderson anderson(problem_.cloth_size);
  projective::LocalGlobalOutcome outcome;
  Array g(problem_.cloth_size);
  Array force(problem_.cloth_size);
  Array p(problem_.cloth_size);
  Array q(problem_.cloth_size);
  Array plain(problem_.cloth_size);  // result of the last iteration without acceleration
  Array to = x;
  double last = std::numeric_limits<double>::infinity();
  Progress progress;
  bool accelerated = false;
  for (;; ++outcome.iterations) {
    checkpoint.check_interrupt();
    smooth.gradient(x, g);
    force = g;
    subtract_impulses(problem_, contacts_, system, x, g, force);
    outcome.residual = smooth.largest_rate(force);
    if (!std::isfinite(outcome.residual)) {
      outcome.status = projective::LocalGlobalStatus::kOverflow;
      return outcome;
    }
    if (outcome.residual < options.tolerance) {
      outcome.status = projective::LocalGlobalStatus::kConverged;
      return outcome;
    }
    if (outcome.iterations == options.max_iterations) return outcome;
    if (checkpoint.is_late()) {
      outcome.status = projective::LocalGlobalStatus::kTimeLimit;
      return outcome;
    }
    if (progress.has_ended(outcome.residual)) {
      outcome.status = projective::LocalGlobalStatus::kStalled;
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
      // Acceleration has failed: continue from the result of the plain iteration.
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

void NodalStage::finish(const Array& x, Report& report, const Forces& forces) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  add_pin_forces(problem_, f, x, forces.pins);
  PairTally tally(report);
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
    const Vec3 force = relative(c, at.g.data());
    spread(c, force, forces.contact);
    const Index cloth = problem_.scene.vertex_cloth[c.vertex];
    if (c.obstacle < 0) {
      tally.add(cloth, problem_.scene.vertex_cloth[c.partner], -scale(c) * force);
      continue;
    }
    const Index body = contacts_.obstacles[c.obstacle].body;
    tally.add(cloth, problem_.scene.cloth_count() + body, -force);
    const auto share = problem_.scene.face_search[body].share(c.surface_point);
    for (int a = 0; a < 3; ++a) {
      Eigen::Map<Vec3>(forces.bodies + 3 * share.corners[a]) -= share.weights[a] * force;
    }
  }
}

}  // namespace diffcloth::step
