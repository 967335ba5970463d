#include "step/motion.h"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace diffcloth::step {
namespace {

/// A body turns along its geodesic in portions of at most this angle [rad]; straight motion of its
/// vertices through a larger one would collapse it.
constexpr double kLargestTurn = 10.0 * std::numbers::pi / 180.0;

Index tree_count(const Scene& scene) {
  return static_cast<Index>(scene.mechanisms.given().tree_free.size());
}

}  // namespace

Motion::Motion(const Problem& problem) : problem_(problem) {
  const double* from = problem.inputs.data(Input::kBodyPoses);
  const double* to = problem.inputs.data(Input::kBodyTargets);
  const solver::Coordinates& coordinates = problem.coordinates;
  double turn = problem.scene.mechanisms.turn_between(coordinates.nodes(problem.start),
                                                      coordinates.nodes(problem.ends));
  for (Index k = 0; k < tree_count(problem.scene); ++k) {
    turn = std::max(turn, bodies::angle(Eigen::Map<const bodies::Pose>(from + 7 * k),
                                        Eigen::Map<const bodies::Pose>(to + 7 * k)));
  }
  portions_ = std::max(1, static_cast<int>(std::ceil(turn / kLargestTurn)));
}

void Motion::end_of_portion(int k, double* x) const {
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
  std::vector<double> poses(7 * static_cast<std::size_t>(tree_count(scene)));
  for (Index b = 0; b < tree_count(scene); ++b) {
    Eigen::Map<bodies::Pose>(poses.data() + 7 * b) =
        bodies::interpolate(Eigen::Map<const bodies::Pose>(from + 7 * b),
                            Eigen::Map<const bodies::Pose>(to + 7 * b), s);
  }
  scene.given.bodies.place(poses.data(), x + cloth);
  if (scene.mechanisms.empty()) return;
  double* const nodes = x + 3 * static_cast<std::ptrdiff_t>(scene.vertex_count());
  for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
    if (scene.mechanisms.given().prescribed[c] == 0) continue;
    const Index slot = scene.mechanisms.slot(c);
    const double start = problem_.coordinates.nodes(problem_.start)[slot];
    nodes[slot] = start + s * (problem_.coordinates.nodes(problem_.ends)[slot] - start);
  }
  scene.mechanisms.set_frames(poses.data(), nodes);
  scene.mechanisms.place(nodes, x + cloth);
}

}  // namespace diffcloth::step
