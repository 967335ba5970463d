#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "bodies/free_motion.h"
#include "bodies/joint_term.h"
#include "bodies/robot_functions.h"
#include "bodies/small_solve.h"
#include "bodies/templated_function.h"

namespace diffcloth::bodies {

/// Effort of a drive from which `asked` is requested: see diffcloth_torch/dynamics/robots.py.
template <class T>
T limited_effort(const T& asked, const T& limit) {
  using std::sqrt;
  const double sign = asked < T(0.0) ? -1.0 : 1.0;
  const T excess = (sign * asked - kLinearShare * limit) / ((1.0 - kLinearShare) * limit);
  if (!(excess > T(0.0))) return asked;
  const T bent = (1.0 - kLinearShare) * limit * excess / sqrt(1.0 + excess * excess);
  return sign * (kLinearShare * limit + bent);
}

/// Gains and targets of a joint, zero if its actuation does not use them.
template <class T>
struct Drive {
  T stiffness, damping, viscosity, position, velocity;
  T asked;    // requested constant effort over the whole step
  T applied;  // the requested effort after limiting
  T limit;    // limit of pd drives

  T effort(const T& start, const T& end, double dt) const {
    return asked + stiffness * (position - end) + damping * (velocity - (end - start) / T(dt));
  }
};

/// Members common to both functions of a robot.
class Robot {
 public:
  explicit Robot(const RobotModel& model)
      : model_(model),
        floats_(model.base == Base::kFloating),
        root_moves_(model.base != Base::kFixed) {
    const Index joints = model.tree.joint_count;
    for (Index j = 0; j < joints; ++j) is_forced_.push_back(is_drive(j) || is_torque(j) ? 1 : 0);
    has_forced_ = std::ranges::count(is_forced_, 1) > 0;
    has_prescribed_ = std::ranges::count(is_forced_, 0) > 0;
    // Without joints, the efforts that hold a prescribed base are not needed.
    has_dynamics_ = is_dynamic() || joints > 0;
    for (Index i = floats_ ? 0 : kRoot; i < kRoot + joints; ++i) {
      if (i < kRoot || is_forced_[i - kRoot] != 0) solved_.push_back(i);
    }
  }

 protected:
  /// Indices of the inputs common to both functions; they precede the inputs of one function.
  enum RobotInput : std::uint8_t {
    kMass,
    kCenter,
    kInertia,
    kArmature,
    kStiffness,
    kDamping,
    kViscosity,
    kTargets,
    kTargetRates,
    kEfforts,
    kEffortLimits,
    kPose,
    kJoints,
    kSharedCount
  };

  Index joint_count() const { return model_.tree.joint_count; }
  Index size() const { return model_.tree.size(); }
  Index link_count() const { return static_cast<Index>(model_.tree.links.size()); }
  Index coordinate_count() const { return model_.coordinate_count(); }
  bool is_dynamic() const { return floats_ || has_forced_; }
  bool is_drive(Index j) const { return model_.actuation[j] == Actuation::kDrive; }
  bool is_torque(Index j) const { return model_.actuation[j] == Actuation::kTorque; }

  static std::vector<SmoothFunction::Array> shared_inputs(const RobotModel& model) {
    const std::size_t J = model.tree.joint_count;
    const std::size_t L = model.tree.links.size();
    return {
        {"mass", {L}},         {"center", {L, 3}}, {"inertia", {L, 3, 3}},       {"armature", {J}},
        {"stiffness", {J}},    {"damping", {J}},   {"viscosity", {J}},           {"targets", {J}},
        {"target_rates", {J}}, {"efforts", {J}},   {"effort_limits", {J}, true}, {"pose", {7}},
        {"joints", {J}}};
  }

  /// Masses and inertias, without the armature of prescribed joints; `armature` must outlive the result.
  template <class T>
  TreeInertia<T> acting(SmoothFunction::Inputs<T> in, std::vector<T>& armature) const {
    for (Index j = 0; j < joint_count(); ++j) {
      armature.push_back(is_forced_[j] != 0 ? in[kArmature][j] : T(0.0));
    }
    return {.mass = in[kMass],
            .center = in[kCenter],
            .inertia = in[kInertia],
            .armature = armature.data()};
  }

  template <class T>
  std::vector<Drive<T>> drives(SmoothFunction::Inputs<T> in) const {
    std::vector<Drive<T>> result;
    for (Index j = 0; j < joint_count(); ++j) {
      Drive<T> drive{};
      drive.limit = model_.largest;
      if (is_forced_[j] != 0) {
        drive.viscosity = in[kViscosity][j];
        drive.asked = drive.applied = in[kEfforts][j];
      }
      if (is_drive(j)) {
        drive.stiffness = in[kStiffness][j];
        drive.damping = in[kDamping][j];
        drive.position = in[kTargets][j];
        drive.velocity = in[kTargetRates][j];
      }
      if (is_forced_[j] != 0 && in[kEffortLimits] != nullptr) {
        // An effort applied to a joint without a drive is limited here. For a drive the limit applies to
        // its total effort, in the joint term; the prediction uses the constant part after limiting.
        drive.applied = limited_effort<T>(drive.asked, in[kEffortLimits][j]);
        if (is_drive(j)) {
          drive.limit = in[kEffortLimits][j];
        } else {
          drive.asked = drive.applied;
        }
      }
      result.push_back(drive);
    }
    return result;
  }

  /// Center of mass and orientation of the root, and values of the joints, at the start.
  template <class T>
  struct Start {
    Vector3<T> back;  // from the center to the origin of the root's frame, in its axes
    Vector3<T> center;
    Quaternion4<T> quaternion;
    Configuration<T> configuration;
  };

  template <class T>
  Start<T> start(SmoothFunction::Inputs<T> in) const {
    const auto [forth, back] = both_ways(vector3(in[kCenter] + 3 * model_.tree.root()));
    const Quaternion4<T> quaternion = orientation(in[kPose]);
    const Matrix3<T> rotation = quaternion_matrix<T>(quaternion);
    return {.back = back,
            .center = vector3(in[kPose]) + rotation * forth,
            .quaternion = quaternion,
            .configuration = {.rotation = rotation, .joints = vector(in[kJoints], joint_count())}};
  }

  template <class T>
  std::vector<PlacedBody<T>> place_at(const TreeInertia<T>& inertia,
                                      const Configuration<T>& at) const {
    return place<T>(model_.tree, inertia, at.rotation, at.joints);
  }

  /// Momentum and slope at the middle of the step.
  template <class T>
  TreeRates<T> middle(const TreeInertia<T>& inertia,
                      const Configuration<T>& start,
                      const VectorX<T>& nu) const {
    return rates_at_middle<T>(model_.tree, inertia, start, nu, model_.dt, root_moves_);
  }

  /// Generalized forces of forces on the vertices, [V, 3].
  template <class T>
  VectorX<T> of_vertices(const std::vector<PlacedBody<T>>& placed, const T* forces) const {
    std::vector<Wrench<T>> wrenches(placed.size());
    // For each link, sum of f v^T over the positions v in its frame.
    std::vector<Matrix3<T>> moments(placed.size(), Matrix3<T>::Zero());
    for (std::size_t v = 0; v < model_.vertex_link.size(); ++v) {
      const Index l = model_.vertex_link[v];
      const Vector3<T> force = vector3(forces + 3 * v);
      wrenches[l].force += force;
      for (int i = 0; i < 3; ++i) moments[l].col(i) += T(model_.points[3 * v + i]) * force;
    }
    for (std::size_t l = 0; l < placed.size(); ++l) {
      Wrench<T>& wrench = wrenches[l];
      wrench.moment = placed[l].origin.cross(wrench.force);
      for (int i = 0; i < 3; ++i) {
        wrench.moment += Vector3<T>(placed[l].rotation.col(i)).cross(Vector3<T>(moments[l].col(i)));
      }
    }
    return generalized_force<T>(model_.tree, placed, wrenches);
  }

  RobotModel model_;
  bool floats_, root_moves_;
  bool has_forced_ = false, has_prescribed_ = false, has_dynamics_ = false;
  std::vector<char> is_forced_;  // [J]
  std::vector<Index> solved_;    // rows of nu that are unknown
};

}  // namespace diffcloth::bodies
