#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

#include <nanobind/eigen/dense.h>
#include <nanobind/stl/array.h>

#include "bind/arrays.h"
#include "bind/kernels/kernels.h"
#include "bodies/exponential.h"
#include "bodies/free_turn.h"
#include "bodies/joint_term.h"
#include "bodies/rotations.h"
#include "common/recorded.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

/// R, dR/dw_i and d2R/dw_i dw_j, 13 matrices.
nb::object exponential(const Vec3& w) {
  const bodies::Exponential at(w);
  const Owned<double> out = make_array<double>({13, 3, 3});
  double* next = out.data;
  const auto append = [&](const Mat3& m) {
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>{next} = m;
    next += 9;
  };
  append(at.value);
  for (const Mat3& m : at.first) append(m);
  for (const auto& row : at.second) {
    for (const Mat3& m : row) append(m);
  }
  return out.array;
}

/// The term of a joint with 1/100 s, a zone of 1/100, k = 40 and F = 0.2: its change between two
/// coordinates, and its slope and curvature at the second.
std::array<double, 3> joint_term(const bodies::JointRow& row, double from, double to) {
  const bodies::JointTerm term = bodies::joint_term(row.data());
  const bodies::JointConstants constants{
      .h = 0.01, .zone = 0.01, .velocity_stiffness = 40.0, .velocity_force = 0.2};
  const bodies::JointForce force = bodies::joint_force(term, constants, to);
  return {bodies::joint_energy_change(term, constants, from, to), force.slope,
          force.curvature + force.sticking + force.turning * force.friction};
}

nb::object free_turns(const Doubles& inertia, const Doubles& momentum, double time) {
  const std::size_t n = momentum.size() / 3;
  const Owned<double> turn = make_array<double>({n, 4});
  const Owned<double> rate = make_array<double>({n, 4, 12});
  const Owned<bool> found = make_array<bool>({n});
  for (std::size_t k = 0; k < n; ++k) {
    bodies::Turn q{};
    bodies::TurnRate dq{};
    found.data[k] =
        bodies::free_turn(inertia.data() + 9 * k, momentum.data() + 3 * k, time, q, &dq);
    std::ranges::copy(q, turn.data + 4 * k);
    for (std::size_t i = 0; i < 4; ++i) std::ranges::copy(dq[i], rate.data + 12 * (4 * k + i));
  }
  return nb::make_tuple(turn.array, rate.array, found.array);
}

/// For w and a moment: the quaternion of w, its logarithm, its matrix, and the torque, 19 numbers; and
/// their derivatives by the six inputs, [19, 6].
nb::object rotations(const Vec3& w, const Vec3& moment) {
  Recording recording;
  const Recorder recorder(recording);
  bodies::Vector3<Recorded> turn;
  bodies::Vector3<Recorded> pull;
  for (int i = 0; i < 3; ++i) turn[i] = Recorded::variable(w[i]);
  for (int i = 0; i < 3; ++i) pull[i] = Recorded::variable(moment[i]);
  const bodies::Quaternion4<Recorded> q = bodies::quaternion_exp<Recorded>(turn);
  const bodies::Vector3<Recorded> log = bodies::quaternion_log<Recorded>(q);
  const bodies::Matrix3<Recorded> R = bodies::quaternion_matrix<Recorded>(q);
  const bodies::Vector3<Recorded> torque = bodies::torque_from_moment<Recorded>(turn, pull);
  std::vector<Recorded> all(q.begin(), q.end());
  all.insert(all.end(), log.begin(), log.end());
  for (int i = 0; i < 9; ++i) all.push_back(R(i / 3, i % 3));
  all.insert(all.end(), torque.begin(), torque.end());
  const Owned<double> numbers = make_array<double>({all.size()});
  const Owned<double> rates = make_array<double>({all.size(), 6});
  for (std::size_t i = 0; i < all.size(); ++i) {
    numbers.data[i] = all[i].value;
    std::vector<double> change(recording.size(), 0.0);
    change[all[i].place] = 1.0;
    recording.pull_back(change);
    std::copy_n(change.data() + 1, 6, rates.data + 6 * i);
  }
  return nb::make_tuple(numbers.array, rates.array);
}

}  // namespace

void body_kernels(nb::module_& m) {
  m.def("exponential", &exponential, "w"_a,
        "The rotation by a vector, its three first and its nine second derivatives.");
  m.def("joint_term", &joint_term, "row"_a, "start"_a, "end"_a,
        "Change of a joint's term, and its slope and curvature at the end.");
  m.def(
      "rotations", &rotations, "w"_a, "moment"_a,
      "Of a rotation vector its quaternion, the logarithm of that, its matrix, and the torque of a "
      "moment; and the derivatives of these 19 numbers, [19, 6].");
  m.def(
      "free_turns", &free_turns, "inertia"_a, "momentum"_a, "time"_a,
      "Quaternions [n, 4] by which free bodies turn in their own axes, from inertias [n, 3, 3] and "
      "momenta [n, 3]; their derivatives by both [n, 4, 12], and whether they were found [n].");
}

}  // namespace diffcloth::bind
