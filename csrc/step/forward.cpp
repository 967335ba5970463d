#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {
namespace {

/// A body turns along its geodesic in portions of at most this angle [rad]; straight motion of its
/// vertices through a larger one would collapse it.
constexpr double kLargestTurn = 10.0 * std::numbers::pi / 180.0;

class Motion : public solver::PrescribedMotion {
 public:
  explicit Motion(const Problem& problem) : problem_(problem) {
    const double* from = problem.inputs.data(Input::kBodyPoses);
    const double* to = problem.inputs.data(Input::kBodyTargets);
    double turn = 0.0;
    for (Index k = 0; k < problem.scene.given.bodies.count(); ++k) {
      turn = std::max(turn, bodies::angle(Eigen::Map<const bodies::Pose>(from + 7 * k),
                                          Eigen::Map<const bodies::Pose>(to + 7 * k)));
    }
    portions_ = std::max(1, static_cast<int>(std::ceil(turn / kLargestTurn)));
  }

  int portions() const override { return portions_; }

  void end_of_portion(int k, double* x) const override {
    const Scene& scene = problem_.scene;
    const std::size_t cloth = 3 * static_cast<std::size_t>(scene.cloth_vertex_count());
    const double s = (k + 1.0) / portions_;
    const bool last = k + 1 == portions_;
    for (const Index i : scene.given.pins) {
      const Vec3 from = row(problem_.start.data(), i);
      const Vec3 to = row(problem_.ends.data(), i);
      Eigen::Map<Vec3>(x + 3 * i) = last ? to : Vec3(from + s * (to - from));
    }
    if (last) {
      std::copy(problem_.ends.begin() + static_cast<std::ptrdiff_t>(cloth), problem_.ends.end(),
                x + cloth);
      return;
    }
    const double* from = problem_.inputs.data(Input::kBodyPoses);
    const double* to = problem_.inputs.data(Input::kBodyTargets);
    std::vector<double> poses(7 * static_cast<std::size_t>(scene.given.bodies.count()));
    for (Index b = 0; b < scene.given.bodies.count(); ++b) {
      Eigen::Map<bodies::Pose>(poses.data() + 7 * b) =
          bodies::interpolate(Eigen::Map<const bodies::Pose>(from + 7 * b),
                              Eigen::Map<const bodies::Pose>(to + 7 * b), s);
    }
    scene.given.bodies.place(poses.data(), x + cloth);
  }

 private:
  const Problem& problem_;
  int portions_;
};

/// The elastic stage of `split`: x^D, without contact. Pins are at their targets.
solver::Outcome solve_elastic_stage(const Problem& problem,
                                    const Motion& motion,
                                    solver::Context context,
                                    std::vector<double>& x) {
  context.broad_phase = nullptr;
  context.path = nullptr;
  x = problem.with_bodies_at_end(problem.predicted.data());
  for (const Index i : problem.scene.given.pins) {
    Eigen::Map<Vec3>(x.data() + 3 * i) = row(problem.ends.data(), i);
  }
  return solver::minimize(problem.elastic_objective(), x, motion, nullptr, context);
}

/// Everything at its end, free vertices where inertia alone (or x^D) would put them.
std::vector<double> guess(const Problem& problem, const solver::Objective& f) {
  std::vector<double> x = problem.with_bodies_at_end(f.target.data());
  for (const Index i : problem.scene.given.pins) {
    Eigen::Map<Vec3>(x.data() + 3 * i) = row(problem.ends.data(), i);
  }
  return x;
}

void merge(const solver::Outcome& outcome, Report& report) {
  report.iterations += outcome.iterations;
  report.residual = std::max(report.residual, outcome.residual);
  report.motion_fraction = std::min(report.motion_fraction, outcome.motion_fraction);
  if (outcome.status == solver::Status::kInfeasibleMotion) {
    report.result = Result::kInfeasibleMotion;
  } else if (outcome.status == solver::Status::kNotConverged &&
             report.result == Result::kConverged) {
    report.result = Result::kNotConverged;
  }
}

/// The bodies and pins that block a motion: those nearest to or in contact with the cloth.
std::string blockers(const Scene& scene, const std::vector<contact::Contact>& contacts) {
  std::vector<char> involved(static_cast<std::size_t>(scene.surface_count()), 0);
  for (const contact::Contact& k : contacts) {
    for (const Index v : k.pair.vertices) involved[scene.collision_mesh.vertex_surface[v]] = 1;
  }
  std::string text;
  for (Index s = 0; s < scene.surface_count(); ++s) {
    if (!involved[s]) continue;
    const bool is_cloth = s < scene.cloth_count();
    text += (text.empty() ? "" : ", ") + std::string(is_cloth ? "cloth " : "body ") +
            std::to_string(is_cloth ? s : s - scene.cloth_count());
  }
  return text;
}

void finish_report(const Scene& scene, const solver::Outcome& outcome, Report& report) {
  report.contact_count = static_cast<Index>(outcome.contacts.size());
  report.minimum_distance = std::numeric_limits<double>::infinity();
  for (const contact::Contact& k : outcome.contacts) {
    report.minimum_distance = std::min(report.minimum_distance, std::sqrt(k.closest.d_sq));
  }
  if (report.result == Result::kInfeasibleMotion) {
    report.message = "in contact: " + blockers(scene, outcome.contacts);
  }
}

/// Contact forces on the bodies' vertices: minus the partial derivative of the contact energy.
void write_body_forces(const Problem& problem,
                       const solver::Objective& f,
                       const std::vector<contact::Contact>& contacts,
                       const double* x,
                       double* out) {
  std::vector<double> g(3 * static_cast<std::size_t>(problem.scene.vertex_count()), 0.0);
  if (f.contact != nullptr) f.contact->add_gradient(contacts, x, g.data());
  if (!f.friction.empty()) f.friction.add_gradient(f.x_start, x, g.data());
  const std::size_t cloth = 3 * problem.masses.size();
  for (std::size_t a = cloth; a < g.size(); ++a) out[a - cloth] = -g[a];
}

}  // namespace

Report forward(const Scene& scene,
               const Inputs& inputs,
               const Checkpoint& checkpoint,
               Outputs outputs,
               FactorCache* factors) {
  Report report;
  contact::BroadPhase::Scratch scratch;
  const Problem problem(scene, inputs);
  const std::size_t cloth = 3 * problem.masses.size();
  contact::CandidateList candidates(scene.broad_phase);
  solver::Context context{.broad_phase = problem.broad_phase(),
                          .candidates = &candidates,
                          .scratch = &scratch,
                          .checkpoint = &checkpoint,
                          .options = scene.given.options,
                          .seconds = &report.seconds,
                          .path = outputs.path};

  std::copy_n(problem.start.begin(), cloth, outputs.positions);
  if (problem.contact) {
    report.message =
        find_overlap(scene, problem.start.data(), problem.contact->parameters().thickness, scratch);
    if (!report.message.empty()) {
      report.result = Result::kIntersectingStart;
      return report;
    }
  }

  const Motion motion(problem);
  FactorCache::Factors kept;
  std::vector<double> x_d;
  if (problem.split()) {
    const solver::Outcome outcome = solve_elastic_stage(problem, motion, context, x_d);
    merge(outcome, report);
    kept.push_back(outcome.factor);
    if (outputs.tape.elastic != nullptr) {
      std::copy_n(x_d.begin(), cloth, outputs.tape.elastic);
      const std::vector<double>& at = outcome.factored_at.empty() ? x_d : outcome.factored_at;
      std::copy_n(at.begin(), cloth, outputs.tape.elastic + cloth);
    }
  }

  solver::Objective f = problem.main_objective(x_d.data());
  std::vector<contact::Contact> lag =
      solver::contacts_at(f, problem.start.data(), problem.broad_phase(), &scratch);
  std::vector<double> x = problem.start;
  solver::Outcome outcome;
  int solves = 0;
  while (solves < scene.given.friction_iterations) {
    if (f.contact != nullptr) f.friction = contact::FrictionSet(*f.contact, lag);
    const std::vector<double> first_guess = guess(problem, f);
    outcome = solver::minimize(f, x, motion, solves == 0 ? &first_guess : nullptr, context);
    merge(outcome, report);
    kept.push_back(outcome.factor);
    if (outputs.tape.iterates != nullptr) {
      const std::vector<double>& at = outcome.factored_at.empty() ? x : outcome.factored_at;
      std::copy_n(x.begin(), cloth, outputs.tape.iterates + solves * cloth);
      std::copy_n(at.begin(), cloth, outputs.tape.factored + solves * cloth);
    }
    ++solves;
    if (report.result != Result::kConverged) break;
    // Without contact before and after, another solve would be the same one.
    if (lag.empty() && outcome.contacts.empty()) break;
    lag = outcome.contacts;
  }

  finish_report(scene, outcome, report);
  if (outputs.tape.solves != nullptr) {
    *outputs.tape.solves = solves;
    *outputs.tape.key = factors->insert(std::move(kept));
  }
  for (std::size_t a = 0; a < cloth; ++a) {
    outputs.positions[a] = x[a];
    outputs.velocities[a] = (x[a] - problem.start[a]) / problem.h;
  }
  write_body_forces(problem, f, outcome.contacts, x.data(), outputs.body_forces);
  return report;
}

}  // namespace diffcloth::step
