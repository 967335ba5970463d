#include "step/schemes/contact_stage.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <string_view>
#include <utility>

#include "solver/newton.h"
#include "step/schemes/contact_points.h"
#include "step/schemes/contact_sum.h"
#include "step/schemes/motion.h"

namespace diffcloth::step {
namespace {

using contact::Contact;
using Array = std::vector<double>;

constexpr std::string_view kUsedUp = "the iterations of the step (`max_iterations`) are used up";
constexpr std::string_view kTimeIsUp = "the time of the step (`max_seconds`) is used up";

void report_contacts(const contact::CollisionMesh& mesh,
                     const std::vector<Contact>& contacts,
                     Report& report) {
  report.contact_count = static_cast<Index>(contacts.size());
  report.minimum_distance = std::numeric_limits<double>::infinity();
  for (const Contact& k : contacts) {
    const double radii = mesh.radius[mesh.vertex_surface[k.pair.vertices[0]]] +
                         mesh.radius[mesh.vertex_surface[k.pair.vertices[3]]];
    report.minimum_distance = std::min(report.minimum_distance, std::sqrt(k.closest.d_sq) - radii);
  }
}

std::string_view words(solver::Criterion criterion) {
  switch (criterion) {
    case solver::Criterion::kTolerance:
    case solver::Criterion::kRounding:
    case solver::Criterion::kNoSolve:
      return {};
    case solver::Criterion::kIterationLimit:
      return kUsedUp;
    case solver::Criterion::kTimeLimit:
      return kTimeIsUp;
    case solver::Criterion::kPrecisionLimit:
      return "rounding hides the last steps: their gain, or their change of the coordinates";
    case solver::Criterion::kNoDescent:
      return "no step along the last direction lowers the energy, however short";
    case solver::Criterion::kBlocked:
      return "collision detection leaves no way along the last direction";
    case solver::Criterion::kIndefinite:
      return "not even the projected Hessian has a factor";
    case solver::Criterion::kNotFinite:
      return "forces are not finite";
    case solver::Criterion::kSaddle:
      return "at a saddle: forces balance to the tolerance, and the Hessian is not positive "
             "definite";
    case solver::Criterion::kStuckMotion:
      return "the motion no longer advances";
    case solver::Criterion::kNoSolution:
      return "no solution of the law of friction at vertices was found";
  }
  __builtin_unreachable();
}

/// Explain why a prescribed motion ended, and name the surfaces near each other that stopped a step.
/// Contacts do not show them: two prescribed surfaces have no contacts, but block each other.
void report_blockers(const Problem& problem,
                     const Array& x,
                     const solver::Outcome& outcome,
                     Report& report) {
  const bool is_infeasible = outcome.motion_fraction < 1.0;
  if (!is_infeasible && outcome.criterion != solver::Criterion::kBlocked) return;
  std::string names;
  if (problem.contact) {
    const contact::Parameters& parameters = problem.contact->parameters();
    names = describe_near(problem.scene, x.data(), parameters.thickness, parameters.d_hat);
  }
  if (is_infeasible) report.message = words(outcome.criterion);
  if (!names.empty()) report.message += (is_infeasible ? "; in contact: " : ": ") + names;
}

/// Forces of contact on all vertices, minus the partial derivative of its energy; forces of attachments
/// on bodies; and forces on pins.
void add_forces(const Problem& problem,
                ContactSum& sum,
                const Potential& attachments,
                const Array& x,
                const Forces& forces) {
  Array g(x.size(), 0.0);
  for (const Potential* p : sum.touching()) p->add_gradient(x.data(), g.data());
  const std::size_t end = 3 * static_cast<std::size_t>(problem.scene.vertex_count());
  for (std::size_t a = 0; a < problem.cloth_size; ++a) forces.contact[a] -= g[a];
  if (problem.scene.has_attached_bodies()) {
    attachments.add_gradient(x.data(), g.data());
  }
  for (std::size_t a = problem.cloth_size; a < end; ++a) {
    forces.bodies[a - problem.cloth_size] -= g[a];
  }
  add_pin_forces(problem, sum.objective, x, forces.pins);
}

}  // namespace

void merge(const solver::Outcome& outcome, Report& report) {
  const bool converged = solver::has_converged(outcome.criterion);
  if (report.result == Result::kConverged || !converged) report.criterion = outcome.criterion;
  report.certified = report.certified && outcome.certified;
  report.residual = std::max(report.residual, outcome.residual);
  report.motion_fraction = std::min(report.motion_fraction, outcome.motion_fraction);
  if (outcome.motion_fraction < 1.0) {
    report.result = Result::kInfeasibleMotion;
  } else if (!converged) {
    report.result = Result::kNotConverged;
    report.message = words(outcome.criterion);
  }
}

std::vector<Field> ContactStage::tape(const Scene& scene) {
  const std::size_t n = static_cast<std::size_t>(scene.cloth_vertex_count()) +
                        static_cast<std::size_t>(scene.mechanisms.node_count());
  const auto k = static_cast<std::size_t>(scene.given.friction_iterations);
  // With the numbers of contacts at the start and after each solve, backward need not search if there
  // are none.
  return {{.name = "iterates", .shape = {k, n, 3}},
          {.name = "solves", .shape = {1}},
          {.name = "contacts", .shape = {k + 1}}};
}

void ContactStage::forward(const Forward& step, Array& x, const Forces& forces) {
  Problem& problem = step.problem;
  const std::size_t size = problem.coordinates.size();
  const int friction_iterations = problem.scene.given.friction_iterations;
  ContactSum sum(potentials(), problem, step.detection, nullptr, nullptr);
  const GeodesicMotion motion(problem);
  const auto keep = [&](int k, const std::vector<Contact>& contacts) {
    if (step.tape.empty()) return;
    step.tape["contacts"][k] = static_cast<double>(contacts.size());
    step.kept.contacts.push_back(contacts);
  };
  const std::vector<Contact>& at_start = sum.contacts_at_start(x);
  keep(0, at_start);
  sum.lag(x, at_start);
  if (sum.friction && problem.origins.empty())
    sum.friction->expect(x.data(), problem.coasting().data());
  {
    const Stopwatch::Scope scope(*step.context.watch, Phase::kAnalysis);
    sum.expect_contacts_near(problem.start);
  }
  // All points at the inertial guess (or x^D), prescribed ones at their ends.
  const Array first_guess = problem.predicted(guess);
  const solver::Departure departure{
      .motion = motion, .guess = problem.scene.given.begins_at_state ? nullptr : &first_guess};
  solver::Factor factor;
  int solves = 0;
  solver::Outcome outcome;
  while (solves < friction_iterations) {
    outcome = solver::minimize(sum.objective, x, solves == 0 ? &departure : nullptr,
                               std::move(factor), step.context);
    merge(outcome, step.report);
    factor = outcome.nearby;
    step.kept.add(std::move(outcome.certificate));
    if (!step.tape.empty()) {
      Array rows;
      problem.coordinates.take_rows(x, rows);
      std::ranges::copy(rows, step.tape["iterates"] + solves * size);
    }
    ++solves;
    if (step.report.result != Result::kConverged) break;
    const std::vector<Contact>& contacts = sum.contacts();
    keep(solves, contacts);
    // Without contact before and after, another solve would repeat this one.
    if (!sum.friction && contacts.empty()) break;
    if (solves < friction_iterations) sum.lag(x, contacts);
  }
  report_contacts(problem.scene.collision_mesh, sum.contacts(), step.report);
  report_blockers(problem, x, outcome, step.report);
  const double reached = step.report.motion_fraction;
  if (reached < 1.0) step.report.root_poses = motion.root_poses(reached);
  if (!step.tape.empty()) *step.tape["solves"] = solves;
  add_forces(problem, sum, *attachments, x, forces);
  const contact::FrictionSet* const friction = sum.friction ? &sum.friction->set() : nullptr;
  if (problem.contact) {
    PairTally(step.report).add(*problem.contact, sum.contacts(), friction, x);
  }
  step.report.points = contact_points(problem, sum.contacts(), friction, x);
}

}  // namespace diffcloth::step
