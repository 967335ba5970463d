#include <algorithm>
#include <chrono>
#include <cstring>

#include "linalg/aligned_buffer.h"
#include "linalg/backend.h"
#include "linalg/cholesky.h"
#include "linalg/symbolic.h"

namespace diffcloth::linalg {
namespace {

/// Adds the time since the last call to a phase; does nothing without a record.
class Stopwatch {
 public:
  explicit Stopwatch(CholeskySeconds* seconds) : seconds_(seconds) {
    if (seconds_ != nullptr) last_ = Clock::now();
  }

  void lap(double CholeskySeconds::* phase) {
    if (seconds_ == nullptr) return;
    const Clock::time_point now = Clock::now();
    seconds_->*phase += std::chrono::duration<double>(now - last_).count();
    last_ = now;
  }

 private:
  using Clock = std::chrono::steady_clock;
  CholeskySeconds* seconds_;
  Clock::time_point last_;
};

/// Multifrontal A = L L^T [Duff and Reid 1983; Liu 1992].
class MultifrontalFactor final : public FactorBackend {
 public:
  MultifrontalFactor(const Symbolic& symbolic, const DenseKernels& kernels)
      : s_(symbolic), kernels_(kernels), factor_(symbolic.factor_size) {}

  bool compute(const double* blocks,
               CholeskyWorkspace& workspace,
               CholeskySeconds* seconds) override {
    double* const arena =
        workspace.reserve(s_.arena_size + static_cast<std::size_t>(s_.longest) * kColumnBlock);
    Stopwatch watch(seconds);
    return std::ranges::all_of(s_.supernodes, [&](const Supernode& node) {
      return eliminate(node, blocks, arena, watch);
    });
  }

  void solve(std::span<const double* const> b, std::span<double* const> x) const override {
    for (std::size_t begin = 0; begin < b.size(); begin += kMaxVectors) {
      const std::size_t count = std::min<std::size_t>(kMaxVectors, b.size() - begin);
      solve_some(b.subspan(begin, count), x.subspan(begin, count));
    }
  }

  std::size_t bytes() const override { return sizeof(*this) + factor_.bytes(); }

 private:
  /// Finish a supernode's columns of L, which its children have added to, and hand its update matrix
  /// on.
  bool eliminate(const Supernode& node, const double* blocks, double* arena, Stopwatch& watch) {
    if (node.children_begin == node.children_end) {
      assemble(node, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    // The update matrix is written before anything is added to it: it need not be cleared.
    double* const u = arena + node.update;
    double* const panel = factor_.data() + node.panel;
    if (!kernels_.factor(node.front, panel, u, arena + s_.arena_size)) return false;
    watch.lap(&CholeskySeconds::dense);
    if (node.parent == -1) return true;
    for (Index c = node.children_begin; c < node.children_end; ++c) {
      const Supernode& child = s_.supernodes[s_.children[c].supernode];
      kernels_.add_to_update(child.front, arena + child.update, map_of(c), node.front, u);
    }
    watch.lap(&CholeskySeconds::extend_add);
    const Supernode& parent = s_.supernodes[node.parent];
    if (node.as_child == parent.children_begin) {
      assemble(parent, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    kernels_.add_to_panel(node.front, u, map_of(node.as_child), parent.front,
                          factor_.data() + parent.panel);
    watch.lap(&CholeskySeconds::extend_add);
    return true;
  }

  /// Begin a supernode's panel: with the columns of A.
  void assemble(const Supernode& node, const double* blocks) {
    double* const panel = factor_.data() + node.panel;
    const auto size = static_cast<std::size_t>(node.front.panel().size(node.front.columns));
    std::memset(panel, 0, sizeof(double) * size);
    for (std::size_t k = node.blocks_begin; k < node.blocks_end; ++k) {
      const PlacedBlock& block = s_.blocks[k];
      const double* const a = blocks + 9 * static_cast<std::ptrdiff_t>(block.slot);
      double* const to = panel + block.place;
      const std::ptrdiff_t ld = block.stride;
      if (block.transposed != 0) {
        for (int j = 0; j < 3; ++j) {
          for (int i = 0; i < 3; ++i) to[i + j * ld] = a[j + 3 * i];
        }
      } else {
        for (int j = 0; j < 3; ++j) {
          for (int i = 0; i < 3; ++i) to[i + j * ld] = a[i + 3 * j];
        }
      }
    }
  }

  ChildMap map_of(Index c) const {
    const Child& child = s_.children[c];
    return {.runs = s_.runs.data() + child.runs_begin,
            .column_runs = child.column_runs,
            .run_count = child.run_count};
  }

  void solve_some(std::span<const double* const> b, std::span<double* const> x) const {
    const auto count = static_cast<int>(b.size());
    const std::size_t n = 3 * s_.vertex.size();
    const std::ptrdiff_t stride = s_.longest;
    std::vector<double> y(n * b.size());  // in the order of elimination, one vector after another
    AlignedBuffer front(static_cast<std::size_t>(stride) * b.size());
    for (std::size_t r = 0; r < b.size(); ++r) {
      for (std::size_t k = 0; k < s_.vertex.size(); ++k) {
        std::copy_n(b[r] + 3 * static_cast<std::ptrdiff_t>(s_.vertex[k]), 3, &y[r * n + 3 * k]);
      }
    }

    double* const c = front.data();
    for (const Supernode& node : s_.supernodes) {  // y := L^-1 y
      const Front& f = node.front;
      for (int r = 0; r < count; ++r) {
        double* const c_r = c + r * stride;
        std::fill_n(c_r, f.ld, 0.0);
        std::copy_n(&y[r * n + 3 * node.first], f.columns, c_r);
      }
      kernels_.forward(f, factor_.data() + node.panel, c, stride, count);
      for (int r = 0; r < count; ++r) {
        const double* const c_r = c + r * stride;
        double* const y_r = y.data() + r * n;
        std::copy_n(c_r, f.columns, y_r + 3 * node.first);
        const double* below = c_r + f.top;
        for (std::size_t k = node.rows_begin; k < node.rows_end; ++k, below += 3) {
          for (int i = 0; i < 3; ++i) y_r[3 * s_.rows[k] + i] += below[i];
        }
      }
    }
    for (std::size_t s = s_.supernodes.size(); s-- > 0;) {  // y := L^-T y
      const Supernode& node = s_.supernodes[s];
      const Front& f = node.front;
      for (int r = 0; r < count; ++r) {
        double* const c_r = c + r * stride;
        const double* const y_r = y.data() + r * n;
        std::fill_n(c_r, f.ld, 0.0);
        std::copy_n(y_r + 3 * node.first, f.columns, c_r);
        double* below = c_r + f.top;
        for (std::size_t k = node.rows_begin; k < node.rows_end; ++k, below += 3) {
          std::copy_n(y_r + 3 * s_.rows[k], 3, below);
        }
      }
      kernels_.backward(f, factor_.data() + node.panel, c, stride, count);
      for (int r = 0; r < count; ++r) {
        std::copy_n(c + r * stride, f.columns, &y[r * n + 3 * node.first]);
      }
    }

    for (std::size_t r = 0; r < b.size(); ++r) {
      for (std::size_t k = 0; k < s_.vertex.size(); ++k) {
        std::copy_n(&y[r * n + 3 * k], 3, x[r] + 3 * static_cast<std::ptrdiff_t>(s_.vertex[k]));
      }
    }
  }

  const Symbolic& s_;
  const DenseKernels& kernels_;
  AlignedBuffer factor_;
};

class MultifrontalAnalysis final : public AnalysisBackend {
 public:
  MultifrontalAnalysis(Symbolic symbolic, KernelLevel level)
      : symbolic_(std::move(symbolic)), kernels_(dense_kernels(level)) {}

  std::unique_ptr<FactorBackend> make_factor() const override {
    return std::make_unique<MultifrontalFactor>(symbolic_, kernels_);
  }
  Index dimension() const override { return 3 * static_cast<Index>(symbolic_.vertex.size()); }
  std::size_t nonzeros() const override { return symbolic_.nonzeros; }
  double flops() const override { return symbolic_.flops; }
  std::size_t bytes() const override { return sizeof(*this) + symbolic_.bytes(); }

 private:
  Symbolic symbolic_;
  const DenseKernels& kernels_;
};

}  // namespace

std::unique_ptr<const AnalysisBackend> analyze_multifrontal(const Elimination& elimination,
                                                            KernelLevel level) {
  return std::make_unique<MultifrontalAnalysis>(
      analyze(elimination.pattern, elimination.graph, elimination.tree), level);
}

}  // namespace diffcloth::linalg
