#include "bodies/free_motion.h"

#include <algorithm>
#include <limits>
#include <ranges>
#include <utility>

#include <Eigen/LU>

namespace diffcloth::bodies {
namespace {

constexpr Index kRoot = 6;  // velocities of the root, which come first

/// Of the scale of x: a step that counts as none, and one that is rounding if it does not shrink.
constexpr double kTolerance = 1e-12;
constexpr double kFloor = 1e-8;
constexpr int kMostIterations = 40;

using Eigen::VectorXd;

Mat3 matrix(const double* rows) {
  return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(rows);
}

double largest(const VectorXd& x) { return x.size() == 0 ? 0.0 : x.cwiseAbs().maxCoeff(); }

/// A link, where it is and how it moves.
struct Body {
  Mat3 rotation;
  Vec3 origin;  // of the link's frame; its joint's axis goes through it
  Vec3 axis;
  Vec3 velocity;  // of the origin
  Vec3 omega;
  Vec3 force;   // momentum of all that hangs on it,
  Vec3 moment;  // and their angular momentum about the world's origin
};

/// Place and velocity of a link behind its parent.
void follow(
    const Body& parent, const Link& link, const VectorXd& joints, const VectorXd& rates, Body& b) {
  b.rotation = parent.rotation * link.offset.leftCols<3>();
  b.origin = parent.origin + parent.rotation * link.offset.col(3);
  b.axis = b.rotation * link.axis;
  b.omega = parent.omega;
  Vec3 slide = Vec3::Zero();
  if (link.kind != JointKind::kFixed) {
    const double value = link.multiplier * joints[link.coordinate] + link.constant;
    const double rate = link.multiplier * rates[link.coordinate];
    if (link.kind == JointKind::kRevolute) {
      b.rotation *= Eigen::AngleAxisd(value, link.axis).toRotationMatrix();
      b.omega += rate * b.axis;
    } else {
      b.origin += value * b.axis;
      slide = rate * b.axis;
    }
  }
  b.velocity = parent.velocity + parent.omega.cross(b.origin - parent.origin) + slide;
}

}  // namespace

/// Where the root and the joints are.
struct FreeMotion::Configuration {
  Vec3 center;
  Mat3 rotation;
  VectorXd joints;
};

/// Momentum p and slope s of velocities nu.
struct FreeMotion::Rates {
  VectorXd momentum;
  VectorXd slope;
};

FreeMotion::FreeMotion(std::vector<Link> links,
                       std::vector<Index> order,
                       Index joint_count,
                       std::vector<Index> solved,
                       bool root_moves,
                       double dt)
    : links_(std::move(links)),
      order_(std::move(order)),
      joint_count_(joint_count),
      solved_(std::move(solved)),
      root_moves_(root_moves),
      dt_(dt) {}

FreeMotion::Configuration FreeMotion::start(const Given& given) const {
  return {.center = row(given.root_center, 0),
          .rotation = matrix(given.root_rotation),
          .joints = Eigen::Map<const VectorXd>(given.joints, joint_count_)};
}

FreeMotion::Configuration FreeMotion::middle(const Given& given, const VectorXd& nu) const {
  const double time = 0.5 * dt_;
  Configuration at = start(given);
  at.joints += time * nu.tail(joint_count_);
  if (!root_moves_) return at;
  at.center += time * nu.head<3>();
  const Vec3 turn = time * nu.segment<3>(3);
  const double angle = turn.norm();
  if (angle > 0.0) at.rotation = Eigen::AngleAxisd(angle, turn / angle) * at.rotation;
  return at;
}

FreeMotion::Rates FreeMotion::rates(const Given& given,
                                    const Configuration& at,
                                    const VectorXd& nu) const {
  const VectorXd joint_rates = nu.tail(joint_count_);
  std::vector<Body> bodies(links_.size());
  for (const Index l : order_) {
    const Link& link = links_[l];
    Body& b = bodies[l];
    const Vec3 center = row(given.center, l);
    if (link.parent < 0) {
      b.rotation = at.rotation;
      b.origin = at.center - at.rotation * center;
      b.axis.setZero();
      b.omega = nu.segment<3>(3);
      b.velocity = nu.head<3>() + b.omega.cross(b.origin - at.center);
    } else {
      follow(bodies[link.parent], link, at.joints, joint_rates, b);
    }
    const Vec3 arm = b.rotation * center;
    b.force = given.mass[l] * (b.velocity + b.omega.cross(arm));
    const Mat3 inertia = matrix(given.inertia + 9 * static_cast<std::ptrdiff_t>(l));
    const Vec3 spin = b.rotation * (inertia * (b.rotation.transpose() * b.omega));
    b.moment = spin + (b.origin + arm).cross(b.force);
  }

  Rates out{.momentum = VectorXd::Zero(kRoot + joint_count_),
            .slope = VectorXd::Zero(kRoot + joint_count_)};
  for (const Index l : std::views::reverse(order_)) {
    const Link& link = links_[l];
    const Body& b = bodies[l];
    if (link.parent < 0) {
      out.momentum.head<3>() = b.force;
      out.momentum.segment<3>(3) = b.moment - at.center.cross(b.force);
      out.slope.segment<3>(3) = b.force.cross(nu.head<3>());
      continue;
    }
    Body& parent = bodies[link.parent];
    parent.force += b.force;
    parent.moment += b.moment;
    if (link.kind == JointKind::kFixed) continue;
    const Vec3 axis_rate = b.omega.cross(b.axis);
    double along = b.axis.dot(b.force);
    double change = axis_rate.dot(b.force);
    if (link.kind == JointKind::kRevolute) {
      const Vec3 moment = b.moment - b.origin.cross(b.force);  // about the axis
      along = b.axis.dot(moment);
      change = axis_rate.dot(moment) + b.axis.dot(b.force.cross(b.velocity));
    }
    out.momentum[kRoot + link.coordinate] += link.multiplier * along;
    out.slope[kRoot + link.coordinate] += link.multiplier * change;
  }
  for (Index j = 0; j < joint_count_; ++j) {
    out.momentum[kRoot + j] += given.armature[j] * nu[kRoot + j];
  }
  return out;
}

VectorXd FreeMotion::residual(const Given& given, const VectorXd& nu) const {
  const Rates at = rates(given, middle(given, nu), nu);
  VectorXd r(solved_.size());
  for (Index k = 0; k < solved_count(); ++k) {
    const Index i = solved_[k];
    r[k] = at.momentum[i] - 0.5 * dt_ * at.slope[i] - given.momentum[i];
  }
  return r;
}

VectorXd FreeMotion::complete(const Given& given, const VectorXd& solved) const {
  VectorXd nu = Eigen::Map<const VectorXd>(given.known, kRoot + joint_count_);
  for (Index k = 0; k < solved_count(); ++k) nu[solved_[k]] = solved[k];
  return nu;
}

bool FreeMotion::solve(const Given& given, double* velocities) const {
  const Index n = solved_count();
  const Configuration here = start(given);
  // Without velocity products, but for those of what is prescribed.
  const VectorXd known = Eigen::Map<const VectorXd>(given.known, kRoot + joint_count_);
  const VectorXd carried = rates(given, here, known).momentum;
  Eigen::MatrixXd mass(n, n);
  VectorXd rest(n);
  for (Index j = 0; j < n; ++j) {
    const VectorXd unit = VectorXd::Unit(kRoot + joint_count_, solved_[j]);
    const VectorXd column = rates(given, here, unit).momentum;
    for (Index i = 0; i < n; ++i) mass(i, j) = column[solved_[i]];
    rest[j] = given.momentum[solved_[j]] - carried[solved_[j]];
  }
  Eigen::MatrixXd H = mass.inverse();
  VectorXd x = H * rest;

  const double scale = std::max(largest(x), largest(known));
  double last = std::numeric_limits<double>::infinity();
  VectorXd r = residual(given, complete(given, x));
  bool found = false;
  for (int iteration = 0; iteration < kMostIterations && !found; ++iteration) {
    const VectorXd step = -(H * r);
    x += step;
    const double size = largest(step);
    const double whole = std::max(largest(x), scale);
    // The next step, which shrinks at least as this one did.
    const double ahead = iteration == 0 ? size : size * (size / last);
    found = ahead <= kTolerance * whole || (size <= kFloor * whole && size >= last / 2.0);
    if (found) break;
    const VectorXd next = residual(given, complete(given, x));
    const VectorXd change = H * (next - r);
    const Eigen::RowVectorXd weight = (step.transpose() * H) / step.dot(change);
    H += (step - change) * weight;
    r = next;
    last = size;
  }
  std::copy_n(x.data(), n, velocities);
  return found;
}

}  // namespace diffcloth::bodies
