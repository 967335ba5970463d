#include "bodies/body_functions.h"

#include <algorithm>
#include <array>
#include <utility>

#include "bodies/free_turn.h"
#include "bodies/small_solve.h"
#include "bodies/templated_function.h"

namespace diffcloth::bodies {
namespace {

constexpr std::size_t kBodyCoordinates = 6;

/// Inputs common to both functions.
struct OfBodies {
  enum Input : std::uint8_t { kMass, kCenter, kInertia, kPoses, kSharedCount };
};

using BodyArrays = std::vector<SmoothFunction::Array>;

/// Add the dimension of the bodies to the shapes of one body.
BodyArrays of_bodies(std::size_t bodies, BodyArrays arrays) {
  for (SmoothFunction::Array& array : arrays) array.shape.insert(array.shape.begin(), bodies);
  return arrays;
}

BodyArrays with_shared(std::size_t bodies, const BodyArrays& own) {
  BodyArrays inputs = {{"mass", {}}, {"center", {3}}, {"inertia", {3, 3}}, {"poses", {7}}};
  inputs.insert(inputs.end(), own.begin(), own.end());
  return of_bodies(bodies, inputs);
}

BodyArrays with_gravity(BodyArrays inputs) {
  inputs.push_back({"gravity", {3}});
  return inputs;
}

/// Free rotation of a body with inertia J and angular momentum l, in its axes.
///
/// @return the quaternion, and true if it was found
std::pair<Quaternion4<double>, bool> free_turn_of(const Matrix3<double>& J,
                                                  const Vector3<double>& l,
                                                  double time) {
  const Eigen::Matrix<double, 3, 3, Eigen::RowMajor> rows = J;
  Turn turn{};
  const bool found = free_turn(rows.data(), l.data(), time, turn, nullptr);
  return {Quaternion4<double>(turn[0], turn[1], turn[2], turn[3]), found};
}

std::pair<Quaternion4<Recorded>, bool> free_turn_of(const Matrix3<Recorded>& J,
                                                    const Vector3<Recorded>& l,
                                                    double time) {
  std::array<Recorded, 12> given{};
  for (int i = 0; i < 9; ++i) given[i] = J(i / 3, i % 3);
  for (int i = 0; i < 3; ++i) given[9 + i] = l[i];
  std::array<double, 12> numbers{};
  std::ranges::transform(given, numbers.begin(), [](const Recorded& x) { return x.value; });
  Turn turn{};
  TurnRate rate{};
  const bool found = free_turn(numbers.data(), numbers.data() + 9, time, turn, &rate);
  Quaternion4<Recorded> result;
  for (int i = 0; i < 4; ++i) {
    result[i] = turn[i];
    // The added value is zero; only the derivatives are recorded.
    for (int j = 0; j < 12; ++j) result[i] += rate[i][j] * (given[j] - numbers[j]);
  }
  return {result, found};
}

class BodyPrediction final : public TemplatedFunction<BodyPrediction>, private OfBodies {
 public:
  BodyPrediction(std::size_t bodies, double dt)
      : TemplatedFunction(
            with_gravity(with_shared(bodies, {{"velocities", {6}}, {"wrenches", {6}}})),
            of_bodies(bodies,
                      {{"frames", {7}},
                       {"coordinates", {kBodyCoordinates}},
                       {"target", {kBodyCoordinates}},
                       {"metric", {kBodyCoordinates, kBodyCoordinates}},
                       {"momentum", {3}},
                       {"speed", {}},
                       {"found", {}}})),
        bodies_(bodies),
        dt_(dt) {}

  template <class T>
  void of(Inputs<T> in, Outputs<T> out) const {
    for (std::size_t k = 0; k < bodies_; ++k) {
      const T& mass = in[kMass][k];
      const Matrix3<T> J = matrix3(in[kInertia] + 9 * k);
      const auto [forth, back] = both_ways(vector3(in[kCenter] + 3 * k));
      const Quaternion4<T> quaternion = orientation(in[kPoses] + 7 * k);
      const Matrix3<T> R = quaternion_matrix<T>(quaternion);
      const Vector3<T> center = vector3(in[kPoses] + 7 * k) + R * forth;
      const T* const velocity = in[kVelocities] + 6 * k;
      const T* const wrench = in[kWrenches] + 6 * k;
      const Vector3<T> speed =
          vector3(velocity) + T(dt_) * (vector3(in[kGravity]) + vector3(wrench) / mass);
      // In body axes at the start.
      const Vector3<T> spin = R.transpose() * vector3(velocity + 3);
      const Vector3<T> torque = R.transpose() * vector3(wrench + 3);
      const Vector3<T> momentum = J * spin + T(dt_) * torque;
      const auto [turn, found] = free_turn_of(J, momentum, dt_);
      const Quaternion4<T> predicted = quaternion_multiply<T>(quaternion, turn);
      const Matrix3<T> turned = quaternion_matrix<T>(predicted);
      const Matrix3<T> moments = turned * Matrix3<T>(J * turned.transpose());

      put<T>(Vector3<T>(turned * back), predicted, out[kFrames] + 7 * k);
      T* const coordinates = out[kOwnCoordinates] + kBodyCoordinates * k;
      put(center, coordinates);
      put(Vector3<T>(-(R * quaternion_log<T>(turn))), coordinates + 3);
      T* const target = out[kTarget] + kBodyCoordinates * k;
      put(Vector3<T>(center + T(dt_) * speed), target);
      std::fill_n(target + 3, 3, T(0.0));
      T* const metric = out[kMetric] + kBodyCoordinates * kBodyCoordinates * k;
      std::fill_n(metric, kBodyCoordinates * kBodyCoordinates, T(0.0));
      for (std::size_t i = 0; i < 3; ++i) {
        metric[kBodyCoordinates * i + i] = mass / T(dt_ * dt_);
        for (std::size_t j = 0; j < 3; ++j) {
          metric[kBodyCoordinates * (3 + i) + 3 + j] = moments(i, j) / T(dt_ * dt_);
        }
      }
      put(Vector3<T>(R * momentum), out[kMomentum] + 3 * k);
      out[kSpeed][k] = speed_of(J, momentum);
      out[kFound][k] = found ? 1.0 : 0.0;
    }
  }

 private:
  enum OwnInput : std::uint8_t { kVelocities = kSharedCount, kWrenches, kGravity };
  enum Output : std::uint8_t {
    kFrames,
    kOwnCoordinates,
    kTarget,
    kMetric,
    kMomentum,
    kSpeed,
    kFound
  };

  template <class T>
  static double speed_of(const Matrix3<T>& J, const Vector3<T>& l) {
    const auto number = [](const T& x) { return value_of(x); };
    const Mat3 moments = J.unaryExpr(number);
    const Vec3 momentum = l.unaryExpr(number);
    return moments.partialPivLu().solve(momentum).norm();
  }

  std::size_t bodies_;
  double dt_;
};

class BodyAdvance final : public TemplatedFunction<BodyAdvance>, private OfBodies {
 public:
  BodyAdvance(std::size_t bodies, double dt)
      : TemplatedFunction(with_shared(bodies,
                                      {{"frames", {7}},
                                       {"coordinates", {kBodyCoordinates}},
                                       {"metric", {kBodyCoordinates, kBodyCoordinates}},
                                       {"momentum", {3}},
                                       {"reached", {kBodyCoordinates}},
                                       {"kick", {kBodyCoordinates}, true}}),
                          of_bodies(bodies, {{"poses", {7}}, {"velocities", {6}}})),
        bodies_(bodies),
        dt_(dt) {}

  template <class T>
  void of(Inputs<T> in, Outputs<T> out) const {
    for (std::size_t k = 0; k < bodies_; ++k) {
      const T* const reached = in[kReached] + kBodyCoordinates * k;
      const Vector3<T> center = vector3(reached);
      const Vector3<T> turn = vector3(reached + 3);
      const Quaternion4<T> quaternion =
          quaternion_multiply<T>(quaternion_exp<T>(turn), vector4(in[kFrames] + 7 * k + 3));
      const Matrix3<T> R = quaternion_matrix<T>(quaternion);
      const T* const metric = in[kMetric] + kBodyCoordinates * kBodyCoordinates * k;
      Vector3<T> moment = Vector3<T>::Zero();
      for (std::size_t i = 0; i < 3; ++i) {
        for (std::size_t j = 0; j < 3; ++j) {
          moment[i] += metric[kBodyCoordinates * (3 + i) + 3 + j] * turn[j];
        }
      }
      Vector3<T> torque = torque_from_moment<T>(turn, moment);
      const T* const before = in[kFirst] + kBodyCoordinates * k;
      Vector3<T> rate = (center - vector3(before)) / T(dt_);
      if (in[kKick] != nullptr) {
        const T* const kick = in[kKick] + kBodyCoordinates * k;
        torque += vector3(kick + 3);
        rate += T(dt_) * vector3(kick) / in[kMass][k];
      }
      const Vector3<T> momentum = vector3(in[kMomentum] + 3 * k) + T(dt_) * torque;
      const MatrixX<T> J = matrix3(in[kInertia] + 9 * k);
      const VectorX<T> local = R.transpose() * momentum;
      const Vector3<T> spin = solve(J, local);
      const Vector3<T> place = center - R * vector3(in[kCenter] + 3 * k);
      put<T>(place, nearer_quaternion<T>(quaternion, vector4(in[kPoses] + 7 * k + 3)),
             out[kEndPoses] + 7 * k);
      put(rate, out[kEndVelocities] + 6 * k);
      put(Vector3<T>(R * spin), out[kEndVelocities] + 6 * k + 3);
    }
  }

 private:
  enum OwnInput : std::uint8_t {
    kFrames = kSharedCount,
    kFirst,
    kMetric,
    kMomentum,
    kReached,
    kKick
  };
  enum Output : std::uint8_t { kEndPoses, kEndVelocities };

  std::size_t bodies_;
  double dt_;
};

}  // namespace

std::unique_ptr<SmoothFunction> body_prediction(std::size_t bodies, double dt) {
  return std::make_unique<BodyPrediction>(bodies, dt);
}

std::unique_ptr<SmoothFunction> body_advance(std::size_t bodies, double dt) {
  return std::make_unique<BodyAdvance>(bodies, dt);
}

}  // namespace diffcloth::bodies
