#include <array>
#include <cstddef>

#include <nanobind/eigen/dense.h>
#include <nanobind/stl/array.h>

#include "bind/arrays.h"
#include "bind/kernels/kernels.h"
#include "bodies/exponential.h"
#include "bodies/joint_term.h"

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

}  // namespace

void body_kernels(nb::module_& m) {
  m.def("exponential", &exponential, "w"_a,
        "The rotation by a vector, its three first and its nine second derivatives.");
  m.def("joint_term", &joint_term, "row"_a, "start"_a, "end"_a,
        "Change of a joint's term, and its slope and curvature at the end.");
}

}  // namespace diffcloth::bind
