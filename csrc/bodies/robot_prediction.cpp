// Motion of a robot over a step without contact and limits: see diffcloth_torch/dynamics/robots.py.

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <type_traits>

#include "bodies/robot.h"
#include "bodies/weight_stiffness.h"

namespace diffcloth::bodies {
namespace {

/// Rotation in a step [rad] beyond which the motion is not unique, and energy is not conserved.
constexpr double kMostTurn = std::numbers::pi;
/// Rotation in a step [rad] below which a fall is ignored.
constexpr double kLittleTurn = 1e-6;

/// Equation of a motion with the same values in another number type, all of them constants.
template <class T>
class Constants {
 public:
  template <class Other>
  explicit Constants(const FreeMotion<Other>& of)
      : mass_(constants(of.inertia.mass, of.tree.links.size())),
        center_(constants(of.inertia.center, 3 * of.tree.links.size())),
        inertia_(constants(of.inertia.inertia, 9 * of.tree.links.size())),
        armature_(constants(of.inertia.armature, of.tree.joint_count)),
        motion_{.tree = of.tree,
                .solved = of.solved,
                .root_moves = of.root_moves,
                .dt = of.dt,
                .inertia = {.mass = mass_.data(),
                            .center = center_.data(),
                            .inertia = inertia_.data(),
                            .armature = armature_.data()},
                .start = {.rotation = of.start.rotation.unaryExpr(Constant{}),
                          .joints = of.start.joints.unaryExpr(Constant{})},
                .known = of.known.unaryExpr(Constant{}),
                .given = of.given.unaryExpr(Constant{})} {}
  Constants(const Constants&) = delete;
  Constants& operator=(const Constants&) = delete;

  const FreeMotion<T>& motion() const { return motion_; }

 private:
  struct Constant {
    template <class Other>
    T operator()(const Other& x) const {
      return value_of(x);
    }
  };
  template <class Other>
  static std::vector<T> constants(const Other* numbers, std::size_t count) {
    std::vector<T> result(count);
    std::transform(numbers, numbers + count, result.begin(), Constant{});
    return result;
  }

  std::vector<T> mass_, center_, inertia_, armature_;
  FreeMotion<T> motion_;
};

/// Velocities without contact; is_lost is true if none were found.
template <class T>
struct FoundMotion {
  VectorX<T> nu;
  bool is_lost = false;
};

class RobotPrediction final : public TemplatedFunction<RobotPrediction>, private Robot {
 public:
  explicit RobotPrediction(const RobotModel& model)
      : TemplatedFunction(inputs_of(model), outputs_of(model)), Robot(model) {
    // Joints that rotate links in a fall. A floating robot falls as a whole, without rotation.
    for (const Link& link : model.tree.links) {
      if (turns(link) && !floats_) turning_.push_back(kRoot + link.coordinate);
    }
    std::ranges::sort(turning_);
    turning_.erase(std::ranges::unique(turning_).begin(), turning_.end());
  }

  template <class T>
  void of(Inputs<T> in, Outputs<T> out) const {
    const double h = model_.dt;
    const Index joints = joint_count();
    const std::vector<Drive<T>> drives = this->drives(in);
    std::vector<T> armature;
    const TreeInertia<T> inertia = acting(in, armature);
    const Start<T> start = this->start(in);
    const VectorX<T> known = prescribed(in, start);
    VectorX<T> ends(joints);
    for (Index j = 0; j < joints; ++j) {
      // A position target is reached exactly, not to the rounding of its velocity.
      ends[j] = model_.actuation[j] == Actuation::kPosition
                    ? in[kTargets][j]
                    : start.configuration.joints[j] + T(h) * known[kRoot + j];
    }
    VectorX<T> given = known;
    if (has_dynamics_) given = this->given(in, inertia, start, drives);
    FoundMotion<T> found{.nu = known};
    if (!solved_.empty() && !model_.is_at_rest) {
      found = free_motion<T>({.tree = model_.tree,
                              .solved = solved_,
                              .root_moves = root_moves_,
                              .dt = model_.dt,
                              .inertia = inertia,
                              .start = start.configuration,
                              .known = known,
                              .given = given});
    }
    const VectorX<T>& nu = found.nu;
    const Configuration<T> end = moved<T>(start.configuration, nu, h, root_moves_);
    VectorX<T> free = end.joints;
    for (Index j = 0; j < joints; ++j) {
      if (is_forced_[j] == 0) free[j] = ends[j];
    }

    put_places(in, start, end, nu, ends, out);
    const Index n = coordinate_count();
    VectorX<T> target(n);
    if (floats_) {
      target.template head<3>() = start.center + T(h) * nu.template head<3>();
      target.template segment<3>(3).setZero();
    }
    target.tail(joints) = free;
    MatrixX<T> metric = MatrixX<T>::Zero(n, n);
    VectorX<T> force = VectorX<T>::Zero(n);
    if (is_dynamic()) {
      MatrixX<T> mass = mass_matrix<T>(model_.tree, inertia, place_at(inertia, end));
      if (!turning_.empty() && !model_.is_at_rest && !found.is_lost) {
        add_change_at_rest(in, inertia, start.configuration, nu, known, given, mass);
      }
      metric = mass.bottomRightCorner(n, n) / T(h * h);
      if (model_.is_at_rest) {
        add_weight_stiffness(in, place_at(inertia, start.configuration), metric);
        force = given.tail(n) / T(h);
      }
    }
    fold(drives, in[kJoints], force, metric, target);
    put<T>(target, out[kTarget]);
    put<T>(metric, out[kMetric]);  // symmetric
    put<T>(nu, out[kNu]);
    put<T>(known, out[kKnown]);
    put<T>(given, out[kGiven]);
    *out[kLost] = found.is_lost ? 1.0 : 0.0;
    if (in[kEffortLimits] != nullptr) put_terms(in, drives, out[kTerms]);
  }

 private:
  enum Input : std::uint8_t {
    kVelocity = kSharedCount,
    kRates,
    kEndPose,
    kWrench,
    kGravity,
    kContact,
    kVelocityLimits,
    kFriction,
    kSlipRates,
    kOrigins
  };
  enum Output : std::uint8_t {
    kRootStart,
    kRootEnd,
    kCoordinates,
    kEnds,
    kTarget,
    kMetric,
    kTerms,
    kNu,
    kKnown,
    kGiven,
    kLost
  };

  static std::vector<Array> inputs_of(const RobotModel& model) {
    const std::size_t J = model.tree.joint_count;
    const std::size_t V = model.vertex_link.size();
    std::vector<Array> inputs = shared_inputs(model);
    const std::vector<Array> own = {{"velocity", {6}},
                                    {"rates", {J}},
                                    {"end_pose", {7}},
                                    {"wrench", {6}},
                                    {"gravity", {3}},
                                    {"contact", {V, 3}, true},
                                    {"velocity_limits", {J}, true},
                                    {"friction", {J}, true},
                                    {"slip_rates", {J}, true},
                                    {"origins", {J}, true}};
    inputs.insert(inputs.end(), own.begin(), own.end());
    return inputs;
  }

  static std::vector<Array> outputs_of(const RobotModel& model) {
    const std::size_t n = model.coordinate_count();
    const std::size_t all = model.tree.size();
    return {{"root_start", {7}},
            {"root_end", {7}},
            {"coordinates", {n}},
            {"ends", {n}},
            {"target", {n}},
            {"metric", {n, n}},
            {"terms", {n, kJointColumns}},
            {"velocity", {all}},
            {"known", {all}},
            {"given", {all}},
            {"lost", {}}};
  }

  bool turns(const Link& link) const {
    return link.kind.turn != 0.0 && is_forced_[link.coordinate] != 0;
  }

  /// Write coordinates at the start, prescribed coordinates at the end, and frames of the root.
  template <class T>
  void put_places(Inputs<T> in,
                  const Start<T>& start,
                  const Configuration<T>& end,
                  const VectorX<T>& nu,
                  const VectorX<T>& ends,
                  Outputs<T> out) const {
    T* coordinates = out[kCoordinates];
    T* last = out[kEnds];
    if (floats_) {
      const Vector3<T> turn = T(model_.dt) * nu.template segment<3>(3);
      const Vector3<T> offset = end.rotation * start.back;
      const Quaternion4<T> turned =
          quaternion_multiply<T>(quaternion_exp<T>(turn), start.quaternion);
      put<T>(offset, turned, out[kRootStart]);
      put<T>(offset, turned, out[kRootEnd]);
      put(start.center, coordinates);
      put(Vector3<T>(-turn), coordinates + 3);
      last = std::copy_n(coordinates, kRoot, last);
      coordinates += kRoot;
    } else {
      std::copy_n(in[kPose], 7, out[kRootStart]);
      std::copy_n(model_.base == Base::kKinematic ? in[kEndPose] : in[kPose], 7, out[kRootEnd]);
    }
    put(start.configuration.joints, coordinates);
    put(ends, last);
  }

  /// The stiffness is a constant: derivatives of an equilibrium do not depend on it.
  template <class T>
  void add_weight_stiffness(Inputs<T> in,
                            const std::vector<PlacedBody<T>>& placed,
                            MatrixX<T>& metric) const {
    constexpr auto kNumber = [](const T& x) { return value_of(x); };
    std::vector<double> mass(placed.size());
    std::transform(in[kMass], in[kMass] + mass.size(), mass.begin(), kNumber);
    std::vector<PlacedBody<double>> numbers(placed.size());
    for (std::size_t l = 0; l < placed.size(); ++l) {
      const PlacedBody<T>& p = placed[l];
      numbers[l].rotation = p.rotation.unaryExpr(kNumber);
      numbers[l].origin = p.origin.unaryExpr(kNumber);
      numbers[l].center = p.center.unaryExpr(kNumber);
      numbers[l].joint = {.angular = p.joint.angular.unaryExpr(kNumber),
                          .linear = p.joint.linear.unaryExpr(kNumber)};
    }
    const Vec3 gravity = vector3(in[kGravity]).unaryExpr(kNumber);
    const auto stiffness = model_.bounds_weight ? weight_stiffness_bound : weight_stiffness;
    const Index n = coordinate_count();
    metric += stiffness(model_.tree, mass, numbers, gravity).bottomRightCorner(n, n).cast<T>();
  }

  /// nu in prescribed rows, zero elsewhere.
  template <class T>
  VectorX<T> prescribed(Inputs<T> in, const Start<T>& start) const {
    VectorX<T> known = VectorX<T>::Zero(size());
    for (Index j = 0; j < joint_count(); ++j) {
      T& rate = known[kRoot + j];
      if (model_.actuation[j] == Actuation::kVelocity) rate = in[kTargetRates][j];
      if (model_.actuation[j] == Actuation::kPosition) {
        rate = (in[kTargets][j] - in[kJoints][j]) / T(model_.dt);
      }
    }
    if (model_.base == Base::kKinematic) {
      const Quaternion4<T> target = orientation(in[kEndPose]);
      const Vector3<T> center = vector3(in[kEndPose]) - quaternion_matrix<T>(target) * start.back;
      known.template head<3>() = (center - start.center) / T(model_.dt);
      known.template segment<3>(3) = turn_between<T>(start.quaternion, target) / T(model_.dt);
    }
    return known;
  }

  /// nu at the start of the step.
  template <class T>
  VectorX<T> velocity(Inputs<T> in) const {
    VectorX<T> nu = VectorX<T>::Zero(size());
    if (root_moves_) nu.template head<6>() = vector(in[kVelocity], kRoot);
    nu.tail(joint_count()) = vector(in[kRates], joint_count());
    return nu;
  }

  /// M(q_n) nu_n + h tau(q_n).
  template <class T>
  VectorX<T> given(Inputs<T> in,
                   const TreeInertia<T>& inertia,
                   const Start<T>& start,
                   const std::vector<Drive<T>>& drives) const {
    const std::vector<PlacedBody<T>> here = place_at(inertia, start.configuration);
    VectorX<T> acting(size());
    acting.template head<6>() = vector(in[kWrench], kRoot);
    for (Index j = 0; j < joint_count(); ++j) acting[kRoot + j] = drives[j].applied;
    const Vector3<T> gravity = vector3(in[kGravity]);
    std::vector<Wrench<T>> weights(here.size());
    for (Index l = 0; l < link_count(); ++l) {
      weights[l].force = inertia.mass[l] * gravity;
      weights[l].moment = here[l].center.cross(weights[l].force);
    }
    acting += generalized_force<T>(model_.tree, here, weights);
    if (in[kContact] != nullptr) acting += of_vertices(here, in[kContact]);
    const VectorX<T> now = velocity(in);
    return rates<T>(model_.tree, inertia, here, now).momentum + T(model_.dt) * acting;
  }

  template <class T>
  FoundMotion<T> free_motion(const FreeMotion<T>& motion) const {
    const Constants<double> numbers(motion);
    Eigen::VectorXd x;
    const bool is_lost = !solve(numbers.motion(), x) || !is_resolved(numbers.motion().complete(x));
    if (is_lost) x.setZero();
    if constexpr (std::is_same_v<T, double>) {
      return {.nu = motion.complete(x), .is_lost = is_lost};
    } else {
      const Eigen::MatrixXd K = jacobian(Constants<Recorded>(motion).motion(), x);
      const VectorX<Recorded> r = motion.residual(x.cast<Recorded>());
      return {.nu = motion.complete(with_derivative(x, K, r)), .is_lost = is_lost};
    }
  }

  /// Jacobian dr/dx of an equation whose inputs are constants.
  static Eigen::MatrixXd jacobian(const FreeMotion<Recorded>& motion, const Eigen::VectorXd& x) {
    Recording recording;
    const Recorder recorder(recording);
    VectorX<Recorded> variables(x.size());
    for (Eigen::Index i = 0; i < x.size(); ++i) variables[i] = Recorded::variable(x[i]);
    const VectorX<Recorded> r = motion.residual(variables);
    Eigen::MatrixXd K(x.size(), x.size());
    std::vector<double> change;
    for (Eigen::Index i = 0; i < x.size(); ++i) {
      change.assign(recording.size(), 0.0);
      change[r[i].place] = 1.0;
      recording.pull_back(change);
      for (Eigen::Index j = 0; j < x.size(); ++j) K(i, j) = change[1 + j];
    }
    return K;
  }

  /// True if a floating base and all joints make less than half a turn in free motion; false for NaN.
  bool is_resolved(const Eigen::VectorXd& nu) const {
    const double most = kMostTurn / model_.dt;
    if (floats_ && !(nu.segment<3>(3).norm() <= most)) return false;
    return std::ranges::all_of(model_.tree.links, [&](const Link& link) {
      return !turns(link) || std::abs(link.turn() * nu[kRoot + link.coordinate]) <= most;
    });
  }

  /// Change M such that it balances the forces on a robot that stays at rest.
  ///
  /// Without contact the robot moves with velocities d in its s unknown rows. If contact holds it at
  /// rest, the impulse that M d lacks should be the impulse y of the forces; but M d includes the
  /// velocity products of a fall that does not happen: M d = y - e. The symmetric change U of rank two,
  ///
  ///   U = (e w^T + w e^T) / k - (e . d) w w^T / k^2,   w = M d,  k = d . w,
  ///
  /// satisfies (M + U) d = y, and U v = 0 for all v that are M-orthogonal to d and M^-1 e. U is scaled
  /// by the fraction of the kinetic energy that one step of the forces adds, because the velocity
  /// products of a moving robot are real.
  template <class T>
  void add_change_at_rest(Inputs<T> in,
                          const TreeInertia<T>& inertia,
                          const Configuration<T>& start,
                          const VectorX<T>& nu,
                          const VectorX<T>& known,
                          const VectorX<T>& given,
                          MatrixX<T>& mass) const {
    using std::sqrt;
    VectorX<T> needed = given;
    if (has_prescribed_ || model_.base == Base::kKinematic) {
      const TreeRates<T> at = middle(inertia, start, known);
      needed += T(0.5 * model_.dt) * at.slope - at.momentum;
    }
    const MatrixX<T> M = pick<T>(mass, solved_);
    const VectorX<T> d = pick<T>(nu, solved_);
    const VectorX<T> w = M * d;
    const VectorX<T> e = pick<T>(needed, solved_) - w;
    // Twice the kinetic energies: of the fall, of the change by one step of the forces, and of the
    // motion.
    const VectorX<T> before = velocity(in);
    VectorX<T> now = known;
    for (const Index i : solved_) now[i] = before[i];
    const VectorX<T> added = d - pick<T>(now, solved_);
    T little = 0.0;
    for (const Index i : turning_) little += mass(i, i);
    little *= (kLittleTurn / model_.dt) * (kLittleTurn / model_.dt);
    const T k = d.dot(w) + little;
    const T gain = added.dot(VectorX<T>(M * added));
    T share = gain / (gain + now.dot(VectorX<T>(mass * now)) + little);
    // A change by more than half could leave M indefinite.
    const T size_sq = e.dot(solve(M, e)) / k;
    const T large_sq = 16.0 * size_sq * size_sq;
    share /= sqrt(sqrt(sqrt(1.0 + large_sq * large_sq)));
    const VectorX<T> unit = w / k;
    const T along = e.dot(d);
    for (std::size_t i = 0; i < solved_.size(); ++i) {
      for (std::size_t j = 0; j < solved_.size(); ++j) {
        const auto a = static_cast<Index>(i);
        const auto b = static_cast<Index>(j);
        mass(solved_[i], solved_[j]) +=
            share * (e[a] * unit[b] + unit[a] * e[b] - along * unit[a] * unit[b]);
      }
    }
  }

  /// Add drives, viscosity and a constant force to 1/2 (q - q^)^T A (q - q^), which results in 1/2 (q -
  /// t)^T A (q - t); `predicted` is q^ before and t after.
  template <class T>
  void fold(const std::vector<Drive<T>>& drives,
            const T* start,
            const VectorX<T>& force,
            MatrixX<T>& metric,
            VectorX<T>& predicted) const {
    if (solved_.empty()) return;
    const double h = model_.dt;
    const Index first = coordinate_count() - joint_count();
    VectorX<T> pull = -force;
    for (Index j = 0; j < joint_count(); ++j) {
      const Drive<T>& drive = drives[j];
      const T moved = predicted[first + j] - start[j];
      pull[first + j] += drive.stiffness * (start[j] + moved - drive.position) +
                         drive.damping * (moved / T(h) - drive.velocity) +
                         drive.viscosity * moved / T(h) - (drive.asked - drive.applied);
      metric(first + j, first + j) += drive.stiffness + (drive.damping + drive.viscosity) / T(h);
    }
    std::vector<Index> unknown = solved_;
    for (Index& i : unknown) i -= size() - coordinate_count();  // indices among the coordinates
    const VectorX<T> shift = solve(pick<T>(metric, unknown), pick<T>(pull, unknown));
    for (std::size_t i = 0; i < unknown.size(); ++i) {
      predicted[unknown[i]] -= shift[static_cast<Index>(i)];
    }
  }

  /// Write the rows of the core's joint terms; rows of prescribed joints are ignored.
  template <class T>
  void put_terms(Inputs<T> in, const std::vector<Drive<T>>& drives, T* rows) const {
    const Index first = coordinate_count() - joint_count();
    for (Index i = 0; i < first; ++i, rows += kJointColumns) {  // a root has no joint
      const JointRow idle{0.0, 0.0, 0.0, model_.largest, model_.largest, 0.0, 1.0};
      std::ranges::copy(idle, rows);
    }
    for (Index j = 0; j < joint_count(); ++j, rows += kJointColumns) {
      const Drive<T>& drive = drives[j];
      const T& start = in[kJoints][j];
      const T& origin = in[kOrigins] != nullptr ? in[kOrigins][j] : start;
      rows[0] = origin;
      rows[1] = drive.effort(start, origin, model_.dt);
      rows[2] = drive.stiffness + drive.damping / T(model_.dt);
      rows[3] = drive.limit;
      rows[4] = in[kVelocityLimits][j];
      rows[5] = in[kFriction][j];
      rows[6] = in[kSlipRates][j];
    }
  }

  std::vector<Index> turning_;
};

}  // namespace

std::unique_ptr<SmoothFunction> robot_prediction(const RobotModel& model) {
  return std::make_unique<RobotPrediction>(model);
}

}  // namespace diffcloth::bodies
