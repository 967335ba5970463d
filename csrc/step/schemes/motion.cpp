#include "step/schemes/motion.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "solver/stopping.h"

namespace diffcloth::step {
namespace {

Index tree_count(const Scene& scene) {
  return static_cast<Index>(scene.mechanisms.given().tree_free.size());
}

}  // namespace

GeodesicMotion::GeodesicMotion(const Problem& problem) : problem_(problem) {
  const double* from = problem.inputs.data(Input::kBodyPoses);
  const double* to = problem.inputs.data(Input::kBodyTargets);
  const solver::Coordinates& coordinates = problem.coordinates;
  double turn = problem.scene.mechanisms.turn_between(coordinates.nodes(problem.start),
                                                      coordinates.nodes(problem.ends));
  for (Index k = 0; k < tree_count(problem.scene); ++k) {
    turn = std::max(turn, bodies::angle(Eigen::Map<const bodies::Pose>(from + 7 * k),
                                        Eigen::Map<const bodies::Pose>(to + 7 * k)));
  }
  portions_ = std::max(
      1, static_cast<int>(std::ceil(turn / solver::stopping::kPrescribedMotion.largest_turn)));
}

std::vector<double> GeodesicMotion::root_poses(double fraction) const {
  const double* from = problem_.inputs.data(Input::kBodyPoses);
  const double* to = problem_.inputs.data(Input::kBodyTargets);
  const Index count = tree_count(problem_.scene);
  std::vector<double> poses(from, from + 7 * static_cast<std::ptrdiff_t>(count));
  for (Index b = 0; fraction > 0.0 && b < count; ++b) {
    const Eigen::Map<const bodies::Pose> start(from + 7 * b);
    const Eigen::Map<const bodies::Pose> end(to + 7 * b);
    if (start == end) continue;  // exact to the bit
    Eigen::Map<bodies::Pose>(poses.data() + 7 * b) = bodies::interpolate(start, end, fraction);
  }
  return poses;
}

void GeodesicMotion::at(double fraction, double* x) const {
  const Scene& scene = problem_.scene;
  const std::size_t cloth = 3 * static_cast<std::size_t>(scene.cloth_vertex_count());
  const bool is_end = fraction == 1.0;
  for (const Index i : scene.given.pins) {
    const Vec3 from = row(problem_.start.data(), i);
    const Vec3 to = row(problem_.ends.data(), i);
    Eigen::Map<Vec3>(x + 3 * i) = is_end ? to : Vec3(from + fraction * (to - from));
  }
  if (is_end) {
    std::copy(problem_.ends.begin() + static_cast<std::ptrdiff_t>(cloth), problem_.ends.end(),
              x + cloth);
    return;
  }
  const std::vector<double> poses = root_poses(fraction);
  scene.given.bodies.place(poses.data(), x + cloth);
  if (scene.mechanisms.empty()) return;
  double* const nodes = x + 3 * static_cast<std::ptrdiff_t>(scene.vertex_count());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    if (scene.mechanisms.given().prescribed[c] == 0) continue;
    const Index slot = scene.mechanisms.slot(c);
    const double start = problem_.coordinates.nodes(problem_.start)[slot];
    nodes[slot] = start + fraction * (problem_.coordinates.nodes(problem_.ends)[slot] - start);
  }
  scene.mechanisms.set_frames(poses.data(), nodes);
  scene.mechanisms.place(nodes, x + cloth);
}

}  // namespace diffcloth::step
