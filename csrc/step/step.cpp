#include "step/step.h"

#include <algorithm>
#include <utility>

#include "step/scheme.h"

namespace diffcloth::step {
namespace {

std::size_t cloth_size(const Scene& scene) {
  return 3 * static_cast<std::size_t>(scene.cloth_vertex_count());
}

}  // namespace

std::vector<Field> output_fields(const Scene& scene) {
  const auto n = static_cast<std::size_t>(scene.cloth_vertex_count());
  const std::size_t v = static_cast<std::size_t>(scene.vertex_count()) - n;
  return {{.name = "positions", .shape = {n, 3}},
          {.name = "velocities", .shape = {n, 3}},
          {.name = "body_forces", .shape = {v, 3}}};
}

std::vector<Field> tape_fields(const Scene& scene) {
  std::vector<Field> fields = scene.scheme->tape(scene);
  fields.push_back({.name = "key", .shape = {1}});
  return fields;
}

Report forward(const Scene& scene,
               const Inputs& inputs,
               const Checkpoint& checkpoint,
               const Arrays<double>& outputs,
               const Arrays<double>& tape,
               FactorCache* factors,
               std::vector<std::vector<double>>* path) {
  Stopwatch watch;
  Report report;
  contact::Detection detection(scene.broad_phase);
  Problem problem(scene, inputs);
  double* const positions = outputs["positions"];
  std::copy_n(problem.start.begin(), cloth_size(scene), positions);
  if (problem.contact) {
    const Stopwatch::Scope scope(watch, Phase::kDetection);
    report.message = find_overlap(scene, problem.start.data(),
                                  problem.contact->parameters().thickness, detection.scratch);
    if (!report.message.empty()) {
      report.result = Result::kIntersectingStart;
      return report;
    }
  }

  linalg::CholeskyWorkspace workspace;
  solver::Context context{.checkpoint = &checkpoint,
                          .options = scene.given.options,
                          .workspace = &workspace,
                          .watch = &watch,
                          .counts = &report.counts,
                          .path = path};
  FactorCache::Factors kept;
  scene.scheme->forward({.problem = problem,
                         .detection = detection,
                         .context = context,
                         .tape = tape,
                         .factors = kept,
                         .report = report},
                        positions, outputs["body_forces"]);
  double* const velocities = outputs["velocities"];
  for (std::size_t a = 0; a < cloth_size(scene); ++a) {
    velocities[a] = (positions[a] - problem.start[a]) / problem.h;
  }
  if (!tape.empty()) *tape["key"] = static_cast<double>(factors->insert(std::move(kept)));
  report.iterations = context.iterations;
  report.seconds = watch.read();
  return report;
}

void backward(const Scene& scene,
              const Inputs& inputs,
              const Arrays<const double>& tape,
              const Arrays<const double>& cotangents,
              const Checkpoint& checkpoint,
              const Gradients& gradients,
              FactorCache& factors) {
  Stopwatch watch;
  solver::Counts counts;
  contact::Detection detection(scene.broad_phase);
  Problem problem(scene, inputs, gradients[Input::kRestPositions] != nullptr);
  Cotangents bars(problem);

  const double* const x_bar = cotangents["positions"];
  const double* const v_bar = cotangents["velocities"];
  const double* const f_bar = cotangents["body_forces"];
  const std::size_t cloth = cloth_size(scene);
  bars.positions.resize(cloth);
  for (std::size_t a = 0; a < cloth; ++a) {
    bars.positions[a] = x_bar[a] + v_bar[a] / problem.h;
    bars.start[a] -= v_bar[a] / problem.h;
  }
  bars.body_forces.assign(f_bar, f_bar + (problem.start.size() - cloth));

  linalg::CholeskyWorkspace workspace;
  solver::Context context{.checkpoint = &checkpoint,
                          .options = scene.given.options,
                          .workspace = &workspace,
                          .watch = &watch,
                          .counts = &counts};
  scene.scheme->backward({.problem = problem,
                          .detection = detection,
                          .context = context,
                          .tape = tape,
                          .factors = factors.find(static_cast<std::int64_t>(*tape["key"])),
                          .cotangents = bars});
  bars.add_predicted(problem, gradients);
  bars.write(problem, gradients);
}

}  // namespace diffcloth::step
