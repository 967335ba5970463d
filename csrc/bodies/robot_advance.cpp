// State of a robot after the solve of a step: see diffcloth_torch/dynamics/robots.py.

#include <algorithm>

#include "bodies/robot.h"

namespace diffcloth::bodies {
namespace {

class RobotAdvance final : public TemplatedFunction<RobotAdvance>, private Robot {
 public:
  explicit RobotAdvance(const RobotModel& model)
      : TemplatedFunction(inputs_of(model), outputs_of(model)), Robot(model) {}

  template <class T>
  void of(Inputs<T> in, Outputs<T> out) const {
    const double h = model_.dt;
    const Index joints = joint_count();
    std::vector<T> armature;
    const TreeInertia<T> inertia = acting(in, armature);
    const Start<T> start = this->start(in);
    const T* const reached = in[kReached] + (floats_ ? kRoot : 0);
    const VectorX<T> known = vector(in[kKnown], size());
    VectorX<T> over = known;
    Configuration<T> end = moved<T>(start.configuration, known, h, root_moves_);
    end.joints = vector(reached, joints);
    std::copy_n(in[kRootEnd], 7, out[kEndPose]);
    if (floats_) {
      const Vector3<T> center = vector3(in[kReached]);
      const Vector3<T> turn = vector3(in[kReached] + 3);
      const Quaternion4<T> last = quaternion_exp<T>(turn);
      const Quaternion4<T> quaternion = quaternion_multiply<T>(last, vector4(in[kRootEnd] + 3));
      const Quaternion4<T> first = quaternion_exp<T>(vector3(in[kFirst] + 3));
      end.rotation = quaternion_matrix<T>(quaternion);
      over.template head<3>() = (center - start.center) / T(h);
      over.template segment<3>(3) = turn_between<T>(first, last) / T(h);
      const Vector3<T> place = center + end.rotation * start.back;
      put<T>(place, nearer_quaternion<T>(quaternion, vector4(in[kPose] + 3)), out[kEndPose]);
    }
    over.tail(joints) = (end.joints - start.configuration.joints) / T(h);
    const std::vector<Drive<T>> drives = this->drives(in);
    for (Index j = 0; j < joints; ++j) {
      const T asked = drives[j].effort(in[kJoints][j], end.joints[j], h);
      const bool is_limited = in[kEffortLimits] != nullptr;
      out[kAppliedEfforts][j] = is_limited ? limited_effort<T>(asked, drives[j].limit) : asked;
    }
    VectorX<T> nu = over;
    if (has_dynamics_) {
      nu = last_velocity(in, inertia, start.configuration, end, over, out[kAppliedEfforts]);
    }
    std::copy_n(nu.data(), kRoot, out[kEndVelocity]);
    std::copy_n(nu.data() + kRoot, joints, out[kEndRates]);
  }

 private:
  enum Input : std::uint8_t {
    kRootEnd = kSharedCount,
    kFirst,
    kKnown,
    kGiven,
    kTarget,
    kMetric,
    kReached,
    kContact,
    kKick
  };
  enum Output : std::uint8_t { kEndPose, kEndVelocity, kEndRates, kAppliedEfforts };

  static std::vector<Array> inputs_of(const RobotModel& model) {
    const std::size_t all = model.tree.size();
    const std::size_t n = model.coordinate_count();
    const std::size_t V = model.vertex_link.size();
    std::vector<Array> inputs = shared_inputs(model);
    const std::vector<Array> own = {
        {"root_end", {7}}, {"coordinates", {n}}, {"known", {all}},
        {"given", {all}},  {"target", {n}},      {"metric", {n, n}},
        {"reached", {n}},  {"contact", {V, 3}},  {"kick", {V, 3}, true}};
    inputs.insert(inputs.end(), own.begin(), own.end());
    return inputs;
  }

  static std::vector<Array> outputs_of(const RobotModel& model) {
    const std::size_t J = model.tree.joint_count;
    return {{"pose", {7}}, {"velocity", {6}}, {"rates", {J}}, {"efforts", {J}}};
  }

  /// Force and torque on the root that moved it from the prediction in the solve: at a minimizer, minus
  /// the gradient of all potentials on the surfaces of the robot, contact and attachments. The residual
  /// left by the tolerance is included, so that velocities from momentum agree with velocities from
  /// positions; contact forces would contain the residual times their stiffness.
  template <class T>
  VectorX<T> on_root(Inputs<T> in) const {
    const Index n = coordinate_count();
    VectorX<T> force = VectorX<T>::Zero(kRoot);
    for (Index i = 0; i < kRoot; ++i) {
      for (Index j = 0; j < n; ++j) {
        force[i] += in[kMetric][i * n + j] * (in[kReached][j] - in[kTarget][j]);
      }
    }
    const Vector3<T> moment = force.template tail<3>();
    force.template tail<3>() = torque_from_moment<T>(vector3(in[kReached] + 3), moment);
    return force;
  }

  /// Velocities nu at the end of a step, from the mean velocities over it; also writes the efforts that
  /// held joints.
  template <class T>
  VectorX<T> last_velocity(Inputs<T> in,
                           const TreeInertia<T>& inertia,
                           const Configuration<T>& start,
                           const Configuration<T>& end,
                           const VectorX<T>& over,
                           T* efforts) const {
    const double h = model_.dt;
    const std::vector<PlacedBody<T>> placed = place_at(inertia, end);
    const TreeRates<T> middle = this->middle(inertia, start, over);
    VectorX<T> impulse = VectorX<T>::Zero(size());
    if (in[kKick] != nullptr) impulse = T(h) * of_vertices(placed, in[kKick]);
    VectorX<T> nu = over;
    if (!solved_.empty()) {
      const VectorX<T> momentum = rates<T>(model_.tree, inertia, placed, over).momentum;
      VectorX<T> change = middle.momentum + T(0.5 * h) * middle.slope + impulse - momentum;
      if (floats_ && !model_.is_at_rest) {
        // Momentum change of the whole robot, to which internal forces of joints do not contribute. The
        // angular momentum is about the root's center, which moves: hence the cross product.
        VectorX<T> outside = vector(in[kGiven], kRoot) + T(h) * on_root(in);
        const Vector3<T> linear = outside.template head<3>();
        const Vector3<T> velocity = over.template head<3>();
        outside.template tail<3>() += T(h) * linear.cross(velocity);
        change.template head<kRoot>() =
            outside + impulse.template head<kRoot>() - momentum.template head<kRoot>();
      }
      const MatrixX<T> mass = mass_matrix<T>(model_.tree, inertia, placed);
      const VectorX<T> by = solve(pick<T>(mass, solved_), pick<T>(change, solved_));
      for (std::size_t i = 0; i < solved_.size(); ++i) {
        nu[solved_[i]] += by[static_cast<Index>(i)];
      }
    }
    if (!has_prescribed_) return nu;
    const VectorX<T> missing =
        rates<T>(model_.tree, inertia, placed, nu).momentum - vector(in[kGiven], size()) - impulse;
    const VectorX<T> held = missing / T(h) - middle.slope - of_vertices(placed, in[kContact]);
    for (Index j = 0; j < joint_count(); ++j) {
      if (is_forced_[j] == 0) efforts[j] = held[kRoot + j];
    }
    return nu;
  }
};

}  // namespace

std::unique_ptr<SmoothFunction> robot_advance(const RobotModel& model) {
  return std::make_unique<RobotAdvance>(model);
}

}  // namespace diffcloth::bodies
