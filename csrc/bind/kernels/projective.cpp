#include <algorithm>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind/kernels/kernels.h"
#include "projective/constant_matrix.h"
#include "projective/coupled_coulomb.h"
#include "projective/primitives.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

using Pairs = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using MutableRows = nb::ndarray<double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

linalg::BlockPattern pattern_of(const Pairs& pairs, std::size_t vertices) {
  std::vector<std::pair<Index, Index>> list;
  list.reserve(pairs.shape(0));
  for (std::size_t k = 0; k < pairs.shape(0); ++k) list.emplace_back(pairs(k, 0), pairs(k, 1));
  return linalg::BlockPattern::from_pairs(static_cast<Index>(vertices), std::move(list));
}

/// A cache of constant matrices on one pattern, with its contents.
class ConstantMatrices {
 public:
  ConstantMatrices(const Pairs& pairs, const Flags& fixed)
      : pattern_(pattern_of(pairs, fixed.shape(0))),
        cache_(pattern_, std::vector<char>(fixed.data(), fixed.data() + fixed.shape(0))) {}

  /// The matrix of values in the order of the pattern: by columns, rows ascending.
  std::shared_ptr<const projective::ConstantMatrix> find(const Values& values) {
    if (values.shape(0) != static_cast<std::size_t>(pattern_.block_count())) {
      throw std::invalid_argument("ConstantMatrices: one value a pair, diagonal included");
    }
    return cache_.find({values.data(), values.data() + values.shape(0)});
  }

 private:
  linalg::BlockPattern pattern_;
  projective::ConstantMatrixCache cache_;
};

projective::Primitive primitive_named(const std::string& kind, const std::vector<double>& size) {
  if (size.size() != 3) throw std::invalid_argument("nearest: `size` must have three numbers");
  return {.kind = projective::primitive_kind(kind), .size = row(size.data(), 0)};
}

/// Distance, normal, surface point and the derivatives of both by a point, 1 + 3 + 3 + 9 + 9 numbers.
std::vector<double> nearest(const std::string& kind,
                            const std::vector<double>& size,
                            const std::vector<double>& point) {
  const Vec3 y = row(point.data(), 0);
  const projective::Nearest near = projective::nearest(primitive_named(kind, size), y);
  std::vector<double> out{near.distance};
  const auto append = [&](const auto& values) {
    out.insert(out.end(), values.data(), values.data() + values.size());
  };
  append(near.normal);
  append(near.surface_point(y));
  append(near.normal_derivative);
  append(near.surface_point_derivative());
  return out;
}

/// Impulses of m contacts, 3 m numbers; normals are rows.
std::vector<double> solve_coulomb(const std::vector<double>& W,
                                  const std::vector<double>& q,
                                  const std::vector<double>& normals,
                                  double friction,
                                  double tolerance,
                                  int max_sweeps) {
  const auto size = static_cast<Eigen::Index>(q.size());
  if (W.size() != q.size() * q.size() || normals.size() != q.size() || q.size() % 3 != 0) {
    throw std::invalid_argument("solve_coulomb: W is [3 m, 3 m], q and normals have 3 m numbers");
  }
  std::vector<projective::RoughPlane> planes;
  for (Index k = 0; 3 * k < static_cast<Index>(size); ++k) {
    planes.push_back({.normal = row(normals.data(), k), .friction = friction});
  }
  Eigen::VectorXd r = Eigen::VectorXd::Zero(size);
  const bool solved = projective::solve_coulomb(
      Eigen::Map<const Eigen::MatrixXd>(W.data(), size, size),
      Eigen::Map<const Eigen::VectorXd>(q.data(), size), planes, tolerance, max_sweeps, r);
  if (!solved) throw std::runtime_error("solve_coulomb: no solution was found");
  return {r.begin(), r.end()};
}

}  // namespace

void projective_kernels(nb::module_& m) {
  m.def("nearest", &nearest, "kind"_a, "size"_a, "point"_a,
        "What a primitive is seen from a point of its frame.");
  m.def("solve_coulomb", &solve_coulomb, "W"_a, "q"_a, "normals"_a, "friction"_a, "tolerance"_a,
        "max_sweeps"_a, "Impulses that obey Coulomb's law with the velocities q + W r.");
  nb::class_<projective::ConstantMatrix>(m, "ConstantMatrix")
      .def(
          "solve",
          [](const projective::ConstantMatrix& self, const Rows& b, const MutableRows& x) {
            projective::ConstantMatrix::Scratch scratch;
            self.solve(b.data(), x.data(), scratch);
          },
          "b"_a.noconvert(), "x"_a.noconvert());
  nb::class_<ConstantMatrices>(m, "ConstantMatrices",
                               "The constant matrices of Projective Dynamics on one pattern.")
      .def(nb::init<const Pairs&, const Flags&>(), "pairs"_a.noconvert(), "fixed"_a.noconvert())
      .def("find", &ConstantMatrices::find, "values"_a.noconvert());
}

}  // namespace diffcloth::bind
