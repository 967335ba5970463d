#include "step/step.h"

#include <algorithm>
#include <array>
#include <utility>

#include "common/processor_time.h"
#include "linalg/reference_factorization.h"
#include "step/scheme.h"
#include "step/schemes/schemes.h"

namespace diffcloth::step {
namespace {

const Scheme& scheme_of(const Scene& scene) {
  return find_scheme(scene.given.scheme, scene.given.integrator);
}

bool wants_barrier(const Gradients& gradients) {
  using enum Input;
  return std::ranges::any_of(
      std::array{kBarrierStiffness, kBarrierDistance, kThickness, kRestPositions},
      [&](Input input) { return gradients[input] != nullptr; });
}

bool wants_friction(const Gradients& gradients) {
  return wants_barrier(gradients) || gradients[Input::kFriction] != nullptr ||
         gradients[Input::kSlipVelocity] != nullptr;
}

/// Cotangents of the points at the end, from the cotangents of the outputs.
void read_outputs(const Problem& problem,
                  const Arrays<const double>& cotangents,
                  Cotangents& bars) {
  const Scene& scene = problem.scene;
  const double* const x_bar = cotangents["positions"];
  const double* const v_bar = cotangents["velocities"];
  const double* const f_bar = cotangents["body_forces"];
  bars.rows.assign(problem.coordinates.size(), 0.0);
  for (std::size_t a = 0; a < problem.cloth_size; ++a) {
    bars.rows[a] = x_bar[a] + v_bar[a] / problem.h;
    bars.start[a] -= v_bar[a] / problem.h;
  }
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    bars.rows[problem.cloth_size + scene.mechanisms.slot(c)] = cotangents["coordinates"][c];
  }
  bars.body_forces.assign(
      f_bar, f_bar + (3 * static_cast<std::size_t>(scene.vertex_count()) - problem.cloth_size));
  const double* const contact_bar = cotangents["contact_forces"];
  bars.contact_forces.assign(contact_bar, contact_bar + problem.cloth_size);
  const double* const pin_bar = cotangents["pin_forces"];
  bars.pin_forces.assign(pin_bar, pin_bar + 3 * scene.given.pins.size());
}

/// Change of the outputs except forces, from the change of all points at the end.
void write_outputs(const Problem& problem,
                   const Tangents& tangents,
                   std::vector<double> x,
                   const Arrays<double>& outputs) {
  double* const positions = outputs["positions"];
  double* const velocities = outputs["velocities"];
  for (std::size_t a = 0; a < problem.cloth_size; ++a) {
    positions[a] = x[a];
    velocities[a] = (x[a] - tangents.start[a]) / problem.h;
  }
  const bodies::Mechanisms& mechanisms = problem.scene.mechanisms;
  for (Index c = 0; c < mechanisms.coordinate_count(); ++c) {
    outputs["coordinates"][c] = problem.coordinates.nodes(x)[mechanisms.slot(c)];
  }
}

Forces forces_of(const Arrays<double>& outputs) {
  return {.bodies = outputs["body_forces"],
          .contact = outputs["contact_forces"],
          .pins = outputs["pin_forces"]};
}

}  // namespace

std::vector<Field> output_fields(const Scene& scene) {
  const auto n = static_cast<std::size_t>(scene.cloth_vertex_count());
  const std::size_t v = static_cast<std::size_t>(scene.vertex_count()) - n;
  const auto q = static_cast<std::size_t>(scene.mechanisms.coordinate_count());
  std::vector<Field> fields{{.name = "positions", .shape = {n, 3}},
                            {.name = "velocities", .shape = {n, 3}},
                            {.name = "body_forces", .shape = {v, 3}},
                            {.name = "contact_forces", .shape = {n, 3}},
                            {.name = "pin_forces", .shape = {scene.given.pins.size(), 3}}};
  if (q > 0) fields.push_back({.name = "coordinates", .shape = {q}});
  return fields;
}

std::vector<Field> tape_fields(const Scene& scene) { return scheme_of(scene).tape(scene); }

std::string find_overlap(const Scene& scene, const Inputs& inputs) {
  std::vector<double> thickness(static_cast<std::size_t>(scene.surface_count()), 0.0);
  if (const double* given = inputs.data(Input::kThickness)) {
    std::copy_n(given, thickness.size(), thickness.begin());
  }
  const Problem problem(scene, inputs);
  const double* const x = problem.start.data();
  contact::BroadPhase::Scratch scratch;
  const auto candidates = find_near(scene, x, thickness, 0.0, scratch);
  return find_overlap(scene, x, thickness, candidates, scratch);
}

namespace {

/// Options of the solves for derivatives, which need a certificate.
solver::Options certifying(solver::Options options) {
  options.certify = true;
  return options;
}

}  // namespace

Report forward(const Scene& scene,
               const Inputs& inputs,
               const Checkpoint& checkpoint,
               const Arrays<double>& outputs,
               const Arrays<double>& tape,
               solver::KeptSolves& kept,
               int threads,
               std::vector<std::vector<double>>* path) {
  Stopwatch watch;
  const double before = processor_seconds();
  Checkpoint limited = checkpoint.with_seconds(scene.given.options.max_seconds);
  Report report;
  contact::Detection detection(scene.broad_phase, &limited);
  Problem problem(scene, inputs);
  double* const positions = outputs["positions"];
  std::copy_n(problem.start.begin(), problem.cloth_size, positions);
  if (problem.contact) {
    const Stopwatch::Scope scope(watch, Phase::kDetection);
    const double* const x = problem.start.data();
    const std::vector<double>& reach = problem.contact->reach();
    // One list for this search, the contacts at the start, and the path to the inertial guess.
    const std::vector<double> guess = problem.predicted(problem.inertia.target().data());
    detection.candidates.prepare(x, guess.data(), reach, detection.scratch);
    contact::Found found;
    detection.candidates.find(x, x, reach, detection.scratch, found);
    report.message = find_overlap(scene, x, problem.contact->parameters().thickness, found.pairs,
                                  detection.scratch);
    if (!report.message.empty()) {
      report.result = Result::kIntersectingStart;
      return report;
    }
    detection.scratch = {};  // the list replaces most searches of all pairs from here on
  }

  linalg::CholeskyWorkspace workspace(threads);
  solver::Context context{.checkpoint = &limited,
                          .options = scene.given.options,
                          .workspace = &workspace,
                          .watch = &watch,
                          .counts = &report.counts,
                          .path = path};
  std::vector<double> x = problem.start;
  scheme_of(scene).forward({.problem = problem,
                            .detection = detection,
                            .context = context,
                            .tape = tape,
                            .kept = kept,
                            .report = report},
                           x, forces_of(outputs));
  std::copy_n(x.begin(), problem.cloth_size, positions);
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    outputs["coordinates"][c] = problem.coordinates.nodes(x)[scene.mechanisms.slot(c)];
  }
  double* const velocities = outputs["velocities"];
  for (std::size_t a = 0; a < problem.cloth_size; ++a) {
    velocities[a] = (positions[a] - problem.start[a]) / problem.h;
  }
  report.iterations = context.iterations;
  report.seconds = watch.read();
  report.cpu_seconds = processor_seconds() - before + workspace.team().helpers_seconds();
  return report;
}

void backward(const Scene& scene,
              const Inputs& inputs,
              const Arrays<const double>& tape,
              const solver::KeptSolves& kept,
              std::span<const Loss> losses,
              int threads,
              const Checkpoint& checkpoint) {
  Stopwatch watch;
  solver::Counts counts;
  contact::Detection detection(scene.broad_phase);
  const Gradients& wanted = losses.front().gradients;
  Problem problem(scene, inputs, &wanted);
  std::vector<Cotangents> bars;
  for (const Loss& loss : losses) {
    bars.emplace_back(problem, wanted);
    read_outputs(problem, loss.cotangents, bars.back());
  }

  linalg::CholeskyWorkspace workspace(threads);
  Checkpoint unlimited = checkpoint;
  solver::Context context{.checkpoint = &unlimited,
                          .options = certifying(scene.given.options),
                          .workspace = &workspace,
                          .watch = &watch,
                          .counts = &counts};
  scheme_of(scene).backward(
      {{.problem = problem, .detection = detection, .context = context, .tape = tape, .kept = kept},
       bars,
       wants_barrier(wanted),
       wants_friction(wanted)});
  const Turn::Exchange exchange = [&](std::size_t l) { bars[l].exchange(problem); };
  for (std::size_t l = 0; l < losses.size(); ++l) {
    const Turn turn(exchange, l);
    bars[l].add_predicted(problem, losses[l].gradients);
    bars[l].write(problem, losses[l].gradients);
  }
}

void tangent(const Scene& scene,
             const Inputs& inputs,
             const Arrays<const double>& tape,
             const solver::KeptSolves& kept,
             std::span<const Direction> directions,
             int threads,
             const Checkpoint& checkpoint) {
  Stopwatch watch;
  solver::Counts counts;
  contact::Detection detection(scene.broad_phase);
  Problem problem(scene, inputs);
  std::vector<Tangents> tangents;
  tangents.reserve(directions.size());
  std::vector<Forces> forces;
  for (const Direction& direction : directions) {
    tangents.emplace_back(problem, direction.tangents);
    forces.push_back(forces_of(direction.outputs));
  }

  linalg::CholeskyWorkspace workspace(threads);
  Checkpoint unlimited = checkpoint;
  solver::Context context{.checkpoint = &unlimited,
                          .options = certifying(scene.given.options),
                          .workspace = &workspace,
                          .watch = &watch,
                          .counts = &counts};
  const auto dx = scheme_of(scene).tangent(
      {{.problem = problem, .detection = detection, .context = context, .tape = tape, .kept = kept},
       tangents,
       forces});
  for (std::size_t l = 0; l < directions.size(); ++l) {
    write_outputs(problem, tangents[l], dx[l], directions[l].outputs);
  }
}

double reference_factorization_seconds(const Scene& scene, const Inputs& inputs, int repeats) {
  Problem p(scene, inputs);
  return linalg::reference_factorization_seconds(
      contact_free_hessian(p, p.start.data(), Curvature::kPositive), repeats);
}

}  // namespace diffcloth::step
