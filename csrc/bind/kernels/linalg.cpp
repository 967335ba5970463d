#include <algorithm>
#include <cstddef>
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
#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"
#include "linalg/conjugate_gradient.h"
#include "linalg/stencil_kernels.h"
#include "solver/stopping.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

using Pairs = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Blocks = nb::ndarray<const double, nb::shape<-1, 9>, nb::c_contig, nb::device::cpu>;
using Vectors = nb::ndarray<const double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using MutableVectors = nb::ndarray<double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;

linalg::Backend backend_named(const std::string& name) {
  for (const linalg::Backend backend : linalg::available_backends()) {
    if (name == linalg::name(backend)) return backend;
  }
  throw std::invalid_argument("Cholesky: `backend` must be one of this build's, got '" + name +
                              "'");
}

linalg::Ordering ordering_named(const std::string& name) {
  using enum linalg::Ordering;
  for (const linalg::Ordering ordering : {kAutomatic, kMinimumDegree, kNestedDissection}) {
    if (name == linalg::name(ordering)) return ordering;
  }
  throw std::invalid_argument("Cholesky: `ordering` is unknown: '" + name + "'");
}

/// A pattern and its analysis.
struct Analysis {
  linalg::BlockPattern pattern;
  std::shared_ptr<const linalg::CholeskyAnalysis> analysis;

  Analysis(Index vertex_count,
           const Pairs& pairs,
           const Flags& fixed,
           const std::string& backend,
           const std::string& level,
           const std::string& ordering) {
    if (fixed.shape(0) != static_cast<std::size_t>(vertex_count)) {
      throw std::invalid_argument("Cholesky: `fixed` must have one entry for each vertex");
    }
    std::vector<std::pair<Index, Index>> list;
    for (std::size_t k = 0; k < pairs.shape(0); ++k) {
      if (pairs(k, 1) < 0 || pairs(k, 0) < pairs(k, 1) || pairs(k, 0) >= vertex_count) {
        throw std::invalid_argument("Cholesky: `pairs` must be (row, column), row >= column");
      }
      list.emplace_back(pairs(k, 0), pairs(k, 1));
    }
    pattern = linalg::BlockPattern::from_pairs(vertex_count, std::move(list));
    analysis = std::make_shared<linalg::CholeskyAnalysis>(
        pattern, std::vector<char>(fixed.data(), fixed.data() + fixed.shape(0)),
        backend_named(backend),
        linalg::CholeskyOptions{
            .level = level.empty() ? linalg::chosen_level() : level_named(level),
            .ordering = ordering_named(ordering)});
  }
};

class Factor {
 public:
  Factor(const Analysis& analysis, bool single)
      : blocks_(static_cast<std::size_t>(analysis.pattern.block_count())),
        vertices_(static_cast<std::size_t>(analysis.pattern.size())),
        factor_(analysis.analysis,
                single ? linalg::Precision::kSingle : linalg::Precision::kDouble) {}

  bool compute(const Blocks& blocks, linalg::CholeskyWorkspace& workspace) {
    check(blocks);
    const nb::gil_scoped_release nogil;
    return factor_.compute(blocks.data(), workspace) == linalg::Verdict::kPositive;
  }

  nb::dict profile(const Blocks& blocks, linalg::CholeskyWorkspace& workspace, int repeats) {
    check(blocks);
    linalg::CholeskySeconds seconds;
    bool positive = true;
    for (int k = 0; k < repeats; ++k) {
      positive = positive &&
                 factor_.compute(blocks.data(), workspace, &seconds) == linalg::Verdict::kPositive;
    }
    if (!positive) throw std::invalid_argument("Factor: the matrix is not positive definite");
    nb::dict result;
    result["assembly"] = seconds.assembly / repeats;
    result["extend-add"] = seconds.extend_add / repeats;
    result["dense"] = seconds.dense / repeats;
    return result;
  }

  void solve(const Vectors& b,
             const MutableVectors& x,
             linalg::CholeskyWorkspace& workspace) const {
    check(b, x);
    std::vector<const double*> from;
    std::vector<double*> to;
    for (std::size_t r = 0; r < b.shape(0); ++r) {
      from.push_back(b.data() + 3 * vertices_ * r);
      to.push_back(x.data() + 3 * vertices_ * r);
    }
    const nb::gil_scoped_release nogil;
    factor_.solve(from, to, workspace);
  }

  const char* verdict(const Blocks& blocks, linalg::CholeskyWorkspace& workspace) {
    check(blocks);
    switch (factor_.compute(blocks.data(), workspace)) {
      case linalg::Verdict::kPositive:
        return "positive";
      case linalg::Verdict::kIndefinite:
        return "indefinite";
      case linalg::Verdict::kUnclear:
        return "unclear";
    }
    throw std::logic_error("unknown verdict");
  }

  std::vector<bool> conjugate_gradients(const Analysis& analysis,
                                        const Blocks& blocks,
                                        const Vectors& b,
                                        const MutableVectors& x,
                                        double tolerance,
                                        int max_iterations,
                                        linalg::CholeskyWorkspace& workspace) const {
    check(blocks);
    check(b, x);
    const linalg::BlockMatrix A = matrix(analysis, blocks);
    std::vector<std::vector<double>> right;
    for (std::size_t r = 0; r < b.shape(0); ++r) {
      const double* const from = b.data() + 3 * vertices_ * r;
      right.emplace_back(from, from + 3 * vertices_);
    }
    std::vector<std::vector<double>> solution(right.size(), std::vector<double>(3 * vertices_));
    const std::vector<char> converged = linalg::conjugate_gradients(
        A, factor_, right, tolerance, max_iterations, workspace, solution);
    for (std::size_t r = 0; r < b.shape(0); ++r) {
      std::ranges::copy(solution[r], x.data() + 3 * vertices_ * r);
    }
    return {converged.begin(), converged.end()};
  }

  bool agrees(const Analysis& analysis,
              const Blocks& blocks,
              const Vectors& b,
              linalg::CholeskyWorkspace& workspace) const {
    check(blocks);
    const std::vector<double> right(b.data(), b.data() + 3 * vertices_);
    std::vector<double> x(right.size(), 0.0);
    factor_.solve(right.data(), x.data(), workspace);
    return linalg::agrees(matrix(analysis, blocks), factor_, right, x, solver::stopping::kAgreement,
                          workspace);
  }

  std::size_t bytes() const { return factor_.bytes(); }

 private:
  static linalg::BlockMatrix matrix(const Analysis& analysis, const Blocks& blocks) {
    static const std::vector<char> none;  // read only for couplings beyond the pattern
    linalg::BlockMatrix result(
        std::make_shared<const linalg::MergedPattern>(linalg::merge(analysis.pattern, {})), none);
    std::copy_n(blocks.data(), 9 * blocks.shape(0), result.blocks());
    return result;
  }

  void check(const Vectors& b, const MutableVectors& x) const {
    if (b.shape(0) != x.shape(0) || b.shape(1) != vertices_ || x.shape(1) != vertices_) {
      throw std::invalid_argument("Factor: `b` and `x` must be [count, vertices, 3]");
    }
  }

  void check(const Blocks& blocks) const {
    if (blocks.shape(0) != blocks_) {
      throw std::invalid_argument("Factor: `blocks` must have one row for each block");
    }
  }

  std::size_t blocks_;
  std::size_t vertices_;
  linalg::CholeskyFactor factor_;
};

/// Lower blocks of a matrix that couples all vertices, after a stencil has been added to zero.
std::vector<double> stencil_blocks(const std::string& level,
                                   Index vertex_count,
                                   const std::vector<Index>& row,
                                   const std::vector<std::vector<double>>& left,
                                   const std::vector<std::vector<double>>& right,
                                   const std::vector<double>& core,
                                   double along,
                                   const std::vector<double>& c,
                                   const std::vector<double>& rest,
                                   const std::vector<double>& turn,
                                   const std::vector<std::vector<double>>& sign) {
  linalg::StencilTerms of;
  of.count = static_cast<int>(row.size());
  of.terms = static_cast<int>(left.size());
  for (std::size_t k = 0; k < left.size(); ++k) of.left[k] = left[k].data();
  for (std::size_t k = 0; k < right.size(); ++k) of.right[k] = right[k].data();
  if (!core.empty()) of.core = core.data();
  of.along = along;
  of.c = c.data();
  if (!rest.empty()) of.rest = rest.data();
  if (!turn.empty()) of.turn = turn.data();
  for (std::size_t e = 0; e < sign.size(); ++e) std::ranges::copy(sign[e], of.sign[e]);
  std::vector<std::pair<Index, Index>> pairs;
  for (Index i = 0; i < vertex_count; ++i) {
    for (Index j = 0; j <= i; ++j) pairs.emplace_back(i, j);
  }
  const auto pattern = linalg::BlockPattern::from_pairs(vertex_count, std::move(pairs));
  std::vector<double> blocks(9 * static_cast<std::size_t>(pattern.block_count()), 0.0);
  linalg::stencil_kernel(level_named(level))(of, row.data(), pattern.column_start().data(),
                                             pattern.row().data(), blocks.data());
  return blocks;
}

}  // namespace

linalg::KernelLevel level_named(const std::string& name) {
  return linalg::level_named(name, "`level`");
}

void linalg_kernels(nb::module_& m) {
  m.def("cholesky_backends", [] {
    std::vector<std::string> names;
    for (const linalg::Backend b : linalg::available_backends())
      names.emplace_back(linalg::name(b));
    return names;
  });
  m.def("kernel_levels", [] {
    std::vector<std::string> names;
    for (const linalg::KernelLevel l : linalg::supported_levels())
      names.emplace_back(linalg::name(l));
    return names;
  });
  m.def("stencil_blocks", &stencil_blocks, "level"_a, "vertex_count"_a, "row"_a, "left"_a,
        "right"_a, "core"_a, "along"_a, "c"_a, "rest"_a, "turn"_a, "sign"_a);
  nb::class_<linalg::CholeskyWorkspace>(m, "CholeskyWorkspace")
      .def(nb::init<int>(), "threads"_a = 1)
      .def("bytes", &linalg::CholeskyWorkspace::bytes);
  nb::class_<Analysis>(m, "CholeskyAnalysis")
      .def(nb::init<Index, const Pairs&, const Flags&, const std::string&, const std::string&,
                    const std::string&>(),
           "vertex_count"_a, "pairs"_a.noconvert(), "fixed"_a.noconvert(),
           "backend"_a = "multifrontal", "level"_a = "", "ordering"_a = "automatic")
      .def("column_start", [](const Analysis& a) { return a.pattern.column_start(); })
      .def("row", [](const Analysis& a) { return a.pattern.row(); })
      .def("dimension", [](const Analysis& a) { return a.analysis->dimension(); })
      .def("bytes", [](const Analysis& a) { return a.analysis->bytes(); })
      .def("nonzeros", [](const Analysis& a) { return a.analysis->nonzeros(); })
      .def("flops", [](const Analysis& a) { return a.analysis->flops(); });
  nb::class_<Factor>(m, "CholeskyFactor")
      .def(nb::init<const Analysis&, bool>(), "analysis"_a, "single"_a = false)
      .def("compute", &Factor::compute, "blocks"_a.noconvert(), "workspace"_a)
      .def("verdict", &Factor::verdict, "blocks"_a.noconvert(), "workspace"_a)
      .def("agrees", &Factor::agrees, "analysis"_a, "blocks"_a.noconvert(), "b"_a.noconvert(),
           "workspace"_a)
      .def("conjugate_gradients", &Factor::conjugate_gradients, "analysis"_a,
           "blocks"_a.noconvert(), "b"_a.noconvert(), "x"_a.noconvert(), "tolerance"_a,
           "max_iterations"_a, "workspace"_a)
      .def("profile", &Factor::profile, "blocks"_a.noconvert(), "workspace"_a, "repeats"_a)
      .def("solve", &Factor::solve, "b"_a.noconvert(), "x"_a.noconvert(), "workspace"_a)
      .def("bytes", &Factor::bytes);
}

}  // namespace diffcloth::bind
