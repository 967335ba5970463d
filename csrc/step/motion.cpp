#include "step/motion.h"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace diffcloth::step {
namespace {

/// A body turns along its geodesic in portions of at most this angle [rad]; straight motion of its
/// vertices through a larger one would collapse it.
constexpr double kLargestTurn = 10.0 * std::numbers::pi / 180.0;

}  // namespace

Motion::Motion(const Problem& problem) : problem_(problem) {
  const double* from = problem.inputs.data(Input::kBodyPoses);
  const double* to = problem.inputs.data(Input::kBodyTargets);
  double turn = 0.0;
  for (Index k = 0; k < problem.scene.given.bodies.count(); ++k) {
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
  std::vector<double> poses(7 * static_cast<std::size_t>(scene.given.bodies.count()));
  for (Index b = 0; b < scene.given.bodies.count(); ++b) {
    Eigen::Map<bodies::Pose>(poses.data() + 7 * b) =
        bodies::interpolate(Eigen::Map<const bodies::Pose>(from + 7 * b),
                            Eigen::Map<const bodies::Pose>(to + 7 * b), s);
  }
  scene.given.bodies.place(poses.data(), x + cloth);
}

}  // namespace diffcloth::step
