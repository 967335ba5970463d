#include "bodies/free_motion.h"

#include <algorithm>
#include <limits>

#include <Eigen/LU>

namespace diffcloth::bodies {
namespace {

/// Step sizes relative to x: converged; and dominated by rounding if the step no longer shrinks.
constexpr double kTolerance = 1e-12;
constexpr double kFloor = 1e-8;
constexpr int kMostIterations = 40;

using Eigen::VectorXd;

double largest(const VectorXd& x) { return x.size() == 0 ? 0.0 : x.cwiseAbs().maxCoeff(); }

}  // namespace

bool solve(const FreeMotion<double>& motion, VectorXd& x) {
  const Configuration<double>& start = motion.start;
  const std::vector<PlacedBody<double>> here =
      place(motion.tree, motion.inertia, start.rotation, start.joints);
  // Start with the products of prescribed velocities alone.
  const VectorXd carried = rates(motion.tree, motion.inertia, here, motion.known).momentum;
  const Eigen::MatrixXd mass = mass_matrix(motion.tree, motion.inertia, here);
  const VectorXd rest = motion.given - carried;
  Eigen::MatrixXd H = pick(mass, motion.solved).inverse();
  x = H * pick(rest, motion.solved);

  const double scale = std::max(largest(x), largest(motion.known));
  double last = std::numeric_limits<double>::infinity();
  VectorXd r = motion.residual(x);
  bool found = false;
  for (int iteration = 0; iteration < kMostIterations && !found; ++iteration) {
    const VectorXd step = -(H * r);
    x += step;
    const double size = largest(step);
    const double whole = std::max(largest(x), scale);
    // Predicted size of the next step, which contracts at least as this one did.
    const double ahead = iteration == 0 ? size : size * (size / last);
    found = ahead <= kTolerance * whole || (size <= kFloor * whole && size >= last / 2.0);
    if (found) break;
    const VectorXd next = motion.residual(x);
    const VectorXd change = H * (next - r);
    const Eigen::RowVectorXd weight = (step.transpose() * H) / step.dot(change);
    H += (step - change) * weight;
    r = next;
    last = size;
  }
  return found;
}

}  // namespace diffcloth::bodies
