#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstring>
#include <limits>
#include <mutex>
#include <type_traits>
#include <utility>
#include <vector>

#include "common/flush_subnormals.h"
#include "common/leading_power.h"
#include "common/team.h"
#include "linalg/aligned_buffer.h"
#include "linalg/backend.h"
#include "linalg/cholesky.h"
#include "linalg/symbolic.h"

namespace diffcloth::linalg {
namespace {

constexpr int kMantissa = 52;
constexpr std::int64_t kBias = 1023;

/// The power of two s with 1 <= s^2 a < 4, for a normal a > 0.
double inverse_root_scale(double a) {
  const auto bits = std::bit_cast<std::int64_t>(a);
  const std::int64_t half = ((bits >> kMantissa) - kBias) >> 1;
  return std::bit_cast<double>((kBias - half) << kMantissa);
}

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

/// Numbers in a cache line.
template <class Real>
constexpr Index kLine = 64 / sizeof(Real);

/// Allocator of the update matrices that tasks leave to others; each gets the lowest free place. Few are
/// alive at a time, but which ones depends on the threads.
template <class Real>
class Shelf {
 public:
  /// @param memory  room for all update matrices
  Shelf(const std::vector<Task>& tasks, Real* memory) : memory_(memory) {
    place_.reserve(tasks.size());
    for (const Task& task : tasks) place_.push_back({.begin = 0, .size = task.update});
    taken_.reserve(tasks.size());
  }

  void take(Index task) {
    const std::lock_guard lock(mutex_);
    Place& place = place_[task];
    auto gap = taken_.begin();
    for (; gap != taken_.end() && gap->begin < place.begin + place.size; ++gap) {
      place.begin = gap->end;
    }
    taken_.insert(gap, {.begin = place.begin, .end = place.begin + place.size, .task = task});
  }

  /// Release all but the last `left` numbers.
  void give_back(Index task, std::size_t left) {
    const std::lock_guard lock(mutex_);
    const auto extent = std::ranges::find(taken_, task, &Extent::task);
    extent->begin = extent->end - left;
    if (left == 0) taken_.erase(extent);
  }

  Real* operator[](Index task) const { return memory_ + place_[task].begin; }

 private:
  struct Place {
    std::size_t begin, size;
  };
  struct Extent {
    std::size_t begin, end;
    Index task;
  };

  Real* memory_;
  std::vector<Place> place_;
  std::mutex mutex_;
  std::vector<Extent> taken_;  // ascending
};

const FrontKernels<double>& fronts(const DenseKernels& kernels, double /*precision*/) {
  return kernels.doubles;
}
const FrontKernels<float>& fronts(const DenseKernels& kernels, float /*precision*/) {
  return kernels.floats;
}

/// Multifrontal A = L L^T [Duff and Reid 1983; Liu 1992], in double or single precision.
///
/// Single precision has a smaller range: the factored matrix is S A S, with powers of two S that scale
/// the diagonal to between 1 and 4.
template <class Real>
class MultifrontalFactor final : public FactorBackend {
 public:
  MultifrontalFactor(const Symbolic& symbolic,
                     const DenseKernels& kernels,
                     const std::shared_ptr<SpareRoom>& room)
      : s_(symbolic), kernels_(fronts(kernels, Real{})), factor_(symbolic.factor_size, room) {}

  Verdict compute(const double* blocks,
                  CholeskyWorkspace& workspace,
                  CholeskySeconds* seconds) override {
    if (kIsScaled && !find_scale(blocks)) return Verdict::kIndefinite;
    const std::size_t scratch = static_cast<std::size_t>(s_.longest) * kColumnBlock;
    const std::size_t own = s_.arena_size + scratch;
    Real* const memory = workspace.reserve<Real>(s_.left_size + own * members(workspace));
    Shelf<Real> shelf(s_.tasks, memory);
    const auto tasks = static_cast<Index>(s_.tasks.size());
    // The first failure in the order of the work decides, regardless of concurrent failures.
    std::atomic<Index> failed = 2 * tasks;
    std::vector<Verdict> verdicts(s_.tasks.size(), Verdict::kPositive);
    // Work item 2 k eliminates task k; item 2 k + 1 adds its update matrix to the panel above.
    const auto ready = [&](Index i, const Team::Done& done) {
      const Index k = i / 2;
      if (i % 2 == 0) return has_all(k, [&](Index child) { return done[2 * child + 1] != 0; });
      const Index before = elder(k);
      return done[2 * k] != 0 && (before == -1 || done[2 * before + 1] != 0);
    };
    const auto go = [&](Index i, int member) {
      if (i > failed) return;
      const Mode mode;
      Stopwatch watch(member == 0 ? seconds : nullptr);
      Real* const arena = memory + s_.left_size + own * static_cast<std::size_t>(member);
      if (i % 2 == 1) {
        hand_on(i / 2, blocks, shelf, watch);
        return;
      }
      verdicts[i / 2] = eliminate(i / 2, blocks, shelf, arena, watch);
      if (verdicts[i / 2] == Verdict::kPositive) return;
      Index first = failed;
      while (i < first && !failed.compare_exchange_weak(first, i)) {
      }
    };
    run(workspace, 2 * tasks, ready, go);
    return failed == 2 * tasks ? Verdict::kPositive : verdicts[failed / 2];
  }

  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& workspace) const override {
    for (std::size_t begin = 0; begin < b.size();) {
      const std::size_t count = at_once(b.size() - begin);
      if (count == 1) {
        solve_some<1>(b.subspan(begin, count), x.subspan(begin, count), workspace);
      } else {
        solve_some<kMaxVectors>(b.subspan(begin, count), x.subspan(begin, count), workspace);
      }
      begin += count;
    }
  }

  Precision precision() const override {
    return kIsScaled ? Precision::kSingle : Precision::kDouble;
  }
  std::size_t bytes() const override {
    return sizeof(*this) + factor_.bytes() + scale_.capacity() * sizeof(double);
  }

 private:
  static constexpr bool kIsScaled = std::is_same_v<Real, float>;

  /// Floating-point mode without flushing. Flushing matters in single precision: numbers decay with the
  /// distance in the sheet, down to subnormal ones.
  struct Ordinary {
    Ordinary() {}  // NOLINT(modernize-use-equals-default): or the variable would count as unused
  };
  using Mode = std::conditional_t<kIsScaled, FlushSubnormals, Ordinary>;

  /// Compute the scale of each unknown. Returns false if the diagonal is not positive and finite.
  bool find_scale(const double* blocks) {
    scale_.resize(3 * s_.vertex.size());
    for (std::size_t k = 0; k < s_.vertex.size(); ++k) {
      for (std::size_t i = 0; i < 3; ++i) {
        const double value = blocks[9 * static_cast<std::size_t>(s_.diagonal[k]) + 4 * i];
        if (!(value > 0.0 && value <= std::numeric_limits<double>::max())) return false;
        scale_[3 * k + i] = inverse_root_scale(value);
      }
    }
    return true;
  }

  /// Number of working threads: one if there is one task.
  std::size_t members(CholeskyWorkspace& workspace) const {
    return s_.tasks.size() > 1 ? static_cast<std::size_t>(workspace.team().size()) : 1;
  }

  /// Run a loop over tasks on that many threads.
  void run(CholeskyWorkspace& workspace,
           Index count,
           const Team::Ready& ready,
           const Team::Body& body) const {
    if (members(workspace) > 1) {
      workspace.team().run(count, ready, body);
    } else {
      Team(1).run(count, ready, body);
    }
  }

  const Supernode& root_of(Index task) const { return s_.supernodes[s_.tasks[task].end - 1]; }

  /// Call visit(task), in order, for the tasks whose roots are children of the supernode of a joining
  /// task.
  template <class Visit>
  void for_children(Index task, Visit visit) const {
    if (!s_.tasks[task].joins) return;
    const Supernode& node = root_of(task);
    for (Index c = node.children_begin; c < node.children_end; ++c) {
      visit(s_.supernodes[s_.children[c].supernode].task);
    }
  }

  /// True if all child tasks pass the test.
  template <class Test>
  bool has_all(Index task, Test test) const {
    bool all = true;
    for_children(task, [&](Index child) { all = all && test(child); });
    return all;
  }

  /// Preceding task among the children of the same parent, or -1.
  Index elder(Index task) const {
    const Supernode& root = root_of(task);
    if (root.parent == -1 || root.as_child == s_.supernodes[root.parent].children_begin) return -1;
    return s_.supernodes[s_.children[root.as_child - 1].supernode].task;
  }

  /// Eliminate the supernodes of a task.
  ///
  /// @param arena  of the thread; followed by scratch for the kernels
  Verdict eliminate(
      Index task, const double* blocks, Shelf<Real>& shelf, Real* arena, Stopwatch& watch) {
    shelf.take(task);
    for (Index s = s_.tasks[task].begin; s < s_.tasks[task].end; ++s) {
      const Supernode& node = s_.supernodes[s];
      Real* const u = &node == &root_of(task) ? shelf[task] : arena + node.update;
      const Verdict verdict = eliminate(node, blocks, shelf, arena, u, watch);
      if (verdict != Verdict::kPositive) return verdict;
      if (&node != &root_of(task) && node.parent != -1) add_to_parent(node, blocks, u, watch);
    }
    for_children(task, [&](Index child) {
      if (left_size(root_of(child)) > 0) shelf.give_back(child, 0);
    });
    return Verdict::kPositive;
  }

  /// Add to the panel above a task the columns of its update matrix that belong there.
  void hand_on(Index task, const double* blocks, Shelf<Real>& shelf, Stopwatch& watch) {
    const Supernode& root = root_of(task);
    if (root.parent == -1) return;
    add_to_parent(root, blocks, shelf[task], watch);
    shelf.give_back(task, left_size(root));
  }

  /// Finish a supernode's columns of L, which already include its children's updates, and compute its
  /// update matrix.
  Verdict eliminate(const Supernode& node,
                    const double* blocks,
                    const Shelf<Real>& shelf,
                    Real* arena,
                    Real* u,
                    Stopwatch& watch) {
    if (node.children_begin == node.children_end) {
      assemble(node, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    // The kernel overwrites the update matrix before children are added, so that it need not be cleared.
    Real* const panel = factor_.data() + node.panel;
    const Verdict verdict = kernels_.factor(node.front, panel, u, arena + s_.arena_size);
    watch.lap(&CholeskySeconds::dense);
    if (verdict != Verdict::kPositive || node.parent == -1) return verdict;
    for (Index c = node.children_begin; c < node.children_end; ++c) {
      const Supernode& child = s_.supernodes[s_.children[c].supernode];
      const Real* const of_child =
          child.task == node.task ? arena + child.update : shelf[child.task];
      kernels_.add_to_update(child.front, of_child, map_of(c), node.front, u);
    }
    watch.lap(&CholeskySeconds::extend_add);
    return Verdict::kPositive;
  }

  /// Add a supernode's update to the parent's panel; the first child also assembles that panel.
  void add_to_parent(const Supernode& node, const double* blocks, const Real* u, Stopwatch& watch) {
    const Supernode& parent = s_.supernodes[node.parent];
    if (node.as_child == parent.children_begin) {
      assemble(parent, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    kernels_.add_to_panel(node.front, u, map_of(node.as_child), parent.front,
                          factor_.data() + parent.panel);
    watch.lap(&CholeskySeconds::extend_add);
  }

  /// Size of the rest of the update matrix, behind the columns added to the parent's panel.
  std::size_t left_size(const Supernode& node) const {
    return s_.tasks[node.task].update - s_.taken_size(node);
  }

  /// Initialize a supernode's panel with the columns of A.
  void assemble(const Supernode& node, const double* blocks) {
    Real* const panel = factor_.data() + node.panel;
    const auto size = static_cast<std::size_t>(node.front.panel().size(node.front.columns));
    std::memset(panel, 0, sizeof(Real) * size);
    for (std::size_t k = node.blocks_begin; k < node.blocks_end; ++k) {
      const PlacedBlock& block = s_.blocks[k];
      const double* const a = blocks + 9 * static_cast<std::ptrdiff_t>(block.slot);
      Real* const to = panel + block.place;
      const std::ptrdiff_t ld = block.stride;
      // Transposition is unpredictable, hence no branch.
      const std::ptrdiff_t down = block.transposed != 0 ? 3 : 1;
      const std::ptrdiff_t across = 4 - down;
      if constexpr (kIsScaled) {
        const double* const row = scale_.data() + 3 * static_cast<std::ptrdiff_t>(block.row);
        const double* const column = scale_.data() + 3 * static_cast<std::ptrdiff_t>(block.column);
        for (int j = 0; j < 3; ++j) {
          for (int i = 0; i < 3; ++i) {
            to[i + j * ld] = static_cast<Real>(a[i * down + j * across] * (row[i] * column[j]));
          }
        }
      } else {
        for (int j = 0; j < 3; ++j) {
          for (int i = 0; i < 3; ++i) to[i + j * ld] = a[i * down + j * across];
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

  /// Right-hand sides during a solve, R numbers an entry; unused lanes are zero.
  template <int R>
  struct Vectors {
    std::span<const double* const> b;
    std::span<double* const> x;
    Real* y;       ///< in the order of elimination
    Real* passed;  ///< updates that tasks pass to rows of other tasks

    /// Powers of two that divide the scaled right-hand sides, so that they are in the range of Real.
    std::array<double, R> unit;
    std::array<double, R> inverse;

    std::size_t count() const { return R == 1 ? 1 : b.size(); }
  };

  template <int R>
  void solve_some(std::span<const double* const> b,
                  std::span<double* const> x,
                  CholeskyWorkspace& workspace) const {
    const std::size_t n = 3 * s_.vertex.size();
    const auto longest = static_cast<std::size_t>(s_.longest);
    // Memory of each thread: its vectors, followed by a front.
    constexpr std::size_t kPadding = kLine<Real>;
    const std::size_t own = (n + longest + kPadding) / kPadding * kPadding;
    const std::size_t all = own * members(workspace);
    Real* const memory = workspace.reserve<Real>(R * (all + n + s_.passed_size));
    Real* const y = memory + R * all;
    Vectors<R> v{.b = b, .x = x, .y = y, .passed = y + R * n, .unit = units<R>(b), .inverse = {}};
    for (std::size_t r = 0; r < R; ++r) v.inverse[r] = 1.0 / v.unit[r];
    const auto tasks = static_cast<Index>(s_.tasks.size());
    const auto ready = [&](Index k, const Team::Done& done) {
      if (k < tasks) return has_all(k, [&](Index child) { return done[child] != 0; });
      const Index task = 2 * tasks - 1 - k;
      const Index parent = s_.tasks[task].parent;
      return done[parent == -1 ? task : 2 * tasks - 1 - parent] != 0;
    };
    const auto go = [&](Index k, int member) {
      const Mode mode;
      Real* const front = memory + R * own * static_cast<std::size_t>(member);
      if (k < tasks) {
        forward(k, v, front + R * longest, front);
      } else {
        backward(2 * tasks - 1 - k, v, front);
      }
    };
    run(workspace, 2 * tasks, ready, go);
  }

  template <int R>
  std::array<double, R> units(std::span<const double* const> b) const {
    std::array<double, R> result;
    result.fill(1.0);
    if (!kIsScaled) return result;
    // A single maximum is a chain of dependent operations: process all sides and coordinates at once.
    std::array<std::array<double, 3>, R> largest{};
    for (std::size_t k = 0; k < s_.vertex.size(); ++k) {
      const std::size_t place = 3 * static_cast<std::size_t>(s_.vertex[k]);
      for (std::size_t r = 0; r < b.size(); ++r) {
        for (std::size_t i = 0; i < 3; ++i) {
          largest[r][i] = std::max(largest[r][i], std::abs(b[r][place + i] * scale_[3 * k + i]));
        }
      }
    }
    for (std::size_t r = 0; r < b.size(); ++r) {
      // The inverses must be normal numbers.
      result[r] = std::clamp(leading_power(std::ranges::max(largest[r])), 0x1p-1022, 0x1p1022);
    }
    return result;
  }

  /// Load the rows of a vertex from the right-hand sides.
  template <int R>
  void take(const Vectors<R>& v, Index k, Real* to) const {
    const std::ptrdiff_t place = 3 * static_cast<std::ptrdiff_t>(s_.vertex[k]);
    for (std::size_t r = 0; r < v.count(); ++r) {
      const double* const from = v.b[r] + place;
      if constexpr (kIsScaled) {
        const double* const scale = scale_.data() + 3 * static_cast<std::ptrdiff_t>(k);
        for (std::size_t i = 0; i < 3; ++i) {
          to[R * i + r] = static_cast<Real>(from[i] * scale[i] * v.inverse[r]);
        }
      } else {
        for (std::size_t i = 0; i < 3; ++i) to[R * i + r] = from[i];
      }
    }
    for (std::size_t r = v.count(); r < R; ++r) {
      for (std::size_t i = 0; i < 3; ++i) to[R * i + r] = Real{};
    }
  }

  /// Store the rows of a vertex to the solutions.
  template <int R>
  void give(const Vectors<R>& v, const Real* from, Index k) const {
    const std::ptrdiff_t place = 3 * static_cast<std::ptrdiff_t>(s_.vertex[k]);
    for (std::size_t r = 0; r < v.count(); ++r) {
      double* const to = v.x[r] + place;
      if constexpr (kIsScaled) {
        const double* const scale = scale_.data() + 3 * static_cast<std::ptrdiff_t>(k);
        for (std::size_t i = 0; i < 3; ++i) {
          to[i] = static_cast<double>(from[R * i + r]) * scale[i] * v.unit[r];
        }
      } else {
        for (std::size_t i = 0; i < 3; ++i) to[i] = from[R * i + r];
      }
    }
  }

  /// Offset of the rows of a vertex.
  template <int R>
  static std::ptrdiff_t entry(Index vertex) {
    return std::ptrdiff_t{3 * R} * vertex;
  }

  /// y := L^-1 y in the columns of a task.
  ///
  /// @param z  [n] vectors of the thread: the right-hand side minus the updates so far
  template <int R>
  void forward(Index k, const Vectors<R>& v, Real* z, Real* c) const {
    const Task& task = s_.tasks[k];
    const Supernode& root = root_of(k);
    for (Index i = s_.supernodes[task.begin].first; i < root.first + root.columns; ++i) {
      take(v, i, z + entry<R>(i));
    }
    for (std::size_t i = root.rows_begin; i < root.rows_end; ++i) {
      std::fill_n(z + entry<R>(s_.rows[i]), 3 * R, Real{});
    }
    for_children(k, [&](Index child) {
      add_rows<R>(root_of(child), v.passed + R * s_.tasks[child].passed, z);
    });
    for (Index s = task.begin; s < task.end; ++s) {
      const Supernode& node = s_.supernodes[s];
      const Front& f = node.front;
      std::copy_n(z + entry<R>(node.first), R * f.columns, c);
      std::fill(c + R * f.columns, c + R * f.ld, Real{});
      if constexpr (R == 1) {
        kernels_.forward(f, factor_.data() + node.panel, c);
      } else {
        kernels_.forward_many(f, factor_.data() + node.panel, c);
      }
      std::copy_n(c, R * f.columns, v.y + entry<R>(node.first));
      add_rows<R>(node, c + R * f.top, z);
    }
    Real* to = v.passed + R * task.passed;
    for (std::size_t i = root.rows_begin; i < root.rows_end; ++i, to += 3 * R) {
      std::copy_n(z + entry<R>(s_.rows[i]), 3 * R, to);
    }
  }

  /// to += values at the rows below a supernode.
  template <int R>
  void add_rows(const Supernode& node, const Real* values, Real* to) const {
    for (std::size_t k = node.rows_begin; k < node.rows_end; ++k, values += 3 * R) {
      Real* const sum = to + entry<R>(s_.rows[k]);
      for (int i = 0; i < 3 * R; ++i) sum[i] += values[i];
    }
  }

  /// x := L^-T y in the columns of a task.
  template <int R>
  void backward(Index k, const Vectors<R>& v, Real* c) const {
    const Task& task = s_.tasks[k];
    for (Index s = task.end; s-- > task.begin;) {
      const Supernode& node = s_.supernodes[s];
      const Front& f = node.front;
      std::copy_n(v.y + entry<R>(node.first), R * f.columns, c);
      std::fill(c + R * f.columns, c + R * f.top, Real{});
      Real* below = c + R * f.top;
      for (std::size_t i = node.rows_begin; i < node.rows_end; ++i, below += 3 * R) {
        std::copy_n(v.y + entry<R>(s_.rows[i]), 3 * R, below);
      }
      std::fill(below, c + R * f.ld, Real{});
      if constexpr (R == 1) {
        kernels_.backward(f, factor_.data() + node.panel, c);
      } else {
        kernels_.backward_many(f, factor_.data() + node.panel, c);
      }
      std::copy_n(c, R * f.columns, v.y + entry<R>(node.first));
      for (Index i = node.first; i < node.first + node.columns; ++i) give(v, v.y + entry<R>(i), i);
    }
  }

  const Symbolic& s_;
  const FrontKernels<Real>& kernels_;
  AlignedBuffer<Real> factor_;
  std::vector<double> scale_;  // [3 n] in the order of elimination; empty for doubles
};

/// Layouts of both precisions, each computed when the first factor needs it.
class MultifrontalAnalysis final : public AnalysisBackend {
 public:
  MultifrontalAnalysis(Elimination elimination, KernelLevel level)
      : elimination_(std::move(elimination)), kernels_(dense_kernels(level)) {}

  std::unique_ptr<FactorBackend> make_factor(
      Precision precision, const std::shared_ptr<SpareRoom>& room) const override {
    if (precision == Precision::kSingle) {
      return std::make_unique<MultifrontalFactor<float>>(singles_.get<float>(elimination_),
                                                         kernels_, room);
    }
    return std::make_unique<MultifrontalFactor<double>>(doubles_.get<double>(elimination_),
                                                        kernels_, room);
  }
  Index dimension() const override { return 3 * elimination_.graph.size(); }
  std::size_t nonzeros() const override { return doubles_.get<double>(elimination_).nonzeros; }
  double flops() const override { return doubles_.get<double>(elimination_).flops; }
  std::size_t bytes() const override {
    const Graph& graph = elimination_.graph;
    const EliminationTree& tree = elimination_.tree;
    const std::size_t indices = elimination_.pattern.row().size() +
                                elimination_.pattern.column_start().size() + graph.start.size() +
                                graph.neighbor.size() + graph.vertex.size() + 4 * tree.order.size();
    return sizeof(*this) + sizeof(Index) * indices + singles_.bytes() + doubles_.bytes();
  }

 private:
  class Layout {
   public:
    template <class Real>
    const Symbolic& get(const Elimination& e) const {
      std::call_once(once_, [&] {
        symbolic_ = analyze(e.pattern, e.graph, e.tree, kLine<Real>);
        bytes_ = symbolic_.bytes();
      });
      return symbolic_;
    }
    std::size_t bytes() const { return bytes_; }

   private:
    mutable std::once_flag once_;
    mutable Symbolic symbolic_;
    mutable std::atomic<std::size_t> bytes_ = 0;
  };

  Elimination elimination_;
  const DenseKernels& kernels_;
  Layout singles_;
  Layout doubles_;
};

}  // namespace

std::unique_ptr<const AnalysisBackend> analyze_multifrontal(Elimination elimination,
                                                            KernelLevel level) {
  return std::make_unique<MultifrontalAnalysis>(std::move(elimination), level);
}

}  // namespace diffcloth::linalg
