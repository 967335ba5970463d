#include <algorithm>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>

#include "bind/kernels/kernels.h"
#include "projective/constant_matrix.h"

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
  for (std::size_t k = 0; k < pairs.shape(0); ++k) list.emplace_back(pairs(k, 0), pairs(k, 1));
  return linalg::BlockPattern::from_pairs(static_cast<Index>(vertices), std::move(list));
}

/// A cache of constant matrices on one pattern, and what it holds.
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

}  // namespace

void projective_kernels(nb::module_& m) {
  nb::class_<projective::ConstantMatrix>(m, "ConstantMatrix")
      .def(
          "solve",
          [](const projective::ConstantMatrix& self, const Rows& b, const MutableRows& x) {
            projective::ConstantMatrix::Scratch scratch;
            self.solve(b.data(), x.data(), scratch);
          },
          "b"_a.noconvert(), "x"_a.noconvert())
      .def(
          "multiply",
          [](const projective::ConstantMatrix& self, const Rows& x, const MutableRows& y) {
            self.multiply(x.data(), y.data());
          },
          "x"_a.noconvert(), "y"_a.noconvert());
  nb::class_<ConstantMatrices>(m, "ConstantMatrices",
                               "The constant matrices of Projective Dynamics on one pattern.")
      .def(nb::init<const Pairs&, const Flags&>(), "pairs"_a.noconvert(), "fixed"_a.noconvert())
      .def("find", &ConstantMatrices::find, "values"_a.noconvert());
}

}  // namespace diffcloth::bind
