#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>

#include "common/types.h"
#include "linalg/block_matrix.h"
#include "linalg/block_pattern.h"
#include "potential/potential.h"

namespace diffcloth::bind {

namespace nb = nanobind;

/// Points of a test, C-contiguous rows of float64.
using PointRows = Eigen::Ref<const Rows3>;

inline void check_point_count(const char* name, const PointRows& x, Index expected) {
  if (x.rows() == expected) return;
  throw std::invalid_argument("potential: `" + std::string(name) + "` must have " +
                              std::to_string(expected) + " rows, got " + std::to_string(x.rows()));
}

/// Hessian of a potential at its current point, [3 n, 3 n], assembled as in a step.
inline Eigen::MatrixXd dense_hessian(const Potential& potential,
                                     const linalg::BlockPattern& base,
                                     const double* x,
                                     Curvature curvature) {
  linalg::Couplings pairs;
  potential.add_couplings(pairs);
  const std::vector<char> none(static_cast<std::size_t>(base.size()), 0);
  linalg::BlockMatrix A(
      std::make_shared<const linalg::MergedPattern>(merge(base, beyond(base, pairs))), none);
  potential.add_hessian(x, curvature, A);
  Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(3 * base.size(), 3 * base.size());
  const linalg::BlockPattern& pattern = A.pattern();
  for (Index j = 0; j < pattern.size(); ++j) {
    for (Index s = pattern.column_start()[j]; s < pattern.column_start()[j + 1]; ++s) {
      const Index i = pattern.row()[s];
      const Mat3 block = Eigen::Map<const Mat3>(A.blocks() + 9 * static_cast<std::ptrdiff_t>(s));
      dense.block<3, 3>(3 * i, 3 * j) = block;
      dense.block<3, 3>(3 * j, 3 * i) = block.transpose();
    }
  }
  return dense;
}

/// Bind the functions common to all potentials: energy, energy_change, gradient, hessian and
/// hessian_product. Inputs and their cotangents are specific to a potential.
///
/// @tparam Kernel  has pattern(), the base pattern over all points; and between(x, to), a potential
/// whose current point is x and whose motion is x -> `to`, until the next call
template <class Kernel>
void bind_potential(nb::class_<Kernel>& kernel) {
  using namespace nb::literals;
  const auto between = [](Kernel& k, const PointRows& x, const PointRows& to) -> Potential& {
    check_point_count("x", x, k.pattern().size());
    check_point_count("to", to, k.pattern().size());
    return k.between(x.data(), to.data());
  };
  kernel
      .def(
          "energy",
          [between](Kernel& k, const PointRows& x) { return between(k, x, x).energy(x.data()); },
          "x"_a.noconvert(), "Energy [J].")
      .def(
          "energy_change",
          [between](Kernel& k, const PointRows& x, const PointRows& to) {
            return between(k, x, to).energy_change(x.data(), to.data());
          },
          "x"_a.noconvert(), "to"_a.noconvert(), "Energy at `to` less that at `x` [J].")
      .def(
          "gradient",
          [between](Kernel& k, const PointRows& x) -> Rows3 {
            Rows3 g = Rows3::Zero(x.rows(), 3);
            between(k, x, x).add_gradient(x.data(), g.data());
            return g;
          },
          "x"_a.noconvert(), "Gradient by the points [N].")
      .def(
          "hessian",
          [between](Kernel& k, const PointRows& x, bool positive) {
            return dense_hessian(between(k, x, x), k.pattern(), x.data(),
                                 positive ? Curvature::kPositive : Curvature::kExact);
          },
          "x"_a.noconvert(), "positive"_a = false, "Hessian [3 n, 3 n], or its positive stand-in.")
      .def(
          "hessian_product",
          [between](Kernel& k, const PointRows& x, const PointRows& z) -> Rows3 {
            check_point_count("z", z, k.pattern().size());
            Rows3 y = Rows3::Zero(x.rows(), 3);
            between(k, x, x).add_hessian_product(x.data(), z.data(), y.data());
            return y;
          },
          "x"_a.noconvert(), "z"_a.noconvert(), "Hessian times z [N].");
}

}  // namespace diffcloth::bind
