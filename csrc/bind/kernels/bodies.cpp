#include <cstddef>

#include <nanobind/eigen/dense.h>

#include "bind/arrays.h"
#include "bind/kernels/kernels.h"
#include "bodies/exponential.h"

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

}  // namespace

void body_kernels(nb::module_& m) {
  m.def("exponential", &exponential, "w"_a,
        "The rotation by a vector, its three first and its nine second derivatives.");
}

}  // namespace diffcloth::bind
