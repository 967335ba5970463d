#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <mutex>
#include <vector>

#include "common/team.h"
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

constexpr std::size_t kLine = 8;  // doubles of a cache line

/// Places for the update matrices that tasks leave to others, always the lowest that is free: few are
/// alive at once, but which ones depends on the threads.
class Shelf {
 public:
  /// @param memory  of the size of all of them
  Shelf(const std::vector<Task>& tasks, double* memory) : memory_(memory) {
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

  /// Give back all but the last `left` doubles.
  void give_back(Index task, std::size_t left) {
    const std::lock_guard lock(mutex_);
    const auto extent = std::ranges::find(taken_, task, &Extent::task);
    extent->begin = extent->end - left;
    if (left == 0) taken_.erase(extent);
  }

  double* operator[](Index task) const { return memory_ + place_[task].begin; }

 private:
  struct Place {
    std::size_t begin, size;
  };
  struct Extent {
    std::size_t begin, end;
    Index task;
  };

  double* memory_;
  std::vector<Place> place_;
  std::mutex mutex_;
  std::vector<Extent> taken_;  // ascending
};

/// Multifrontal A = L L^T [Duff and Reid 1983; Liu 1992].
class MultifrontalFactor final : public FactorBackend {
 public:
  MultifrontalFactor(const Symbolic& symbolic, const DenseKernels& kernels)
      : s_(symbolic), kernels_(kernels), factor_(symbolic.factor_size) {}

  bool compute(const double* blocks,
               CholeskyWorkspace& workspace,
               CholeskySeconds* seconds) override {
    const std::size_t scratch = static_cast<std::size_t>(s_.longest) * kColumnBlock;
    const std::size_t own = s_.arena_size + scratch;
    double* const memory = workspace.reserve(s_.left_size + own * members(workspace));
    Shelf shelf(s_.tasks, memory);
    std::atomic<bool> positive = true;
    // Work 2 k eliminates task k, work 2 k + 1 hands on what it leaves.
    const auto ready = [&](Index i, const Team::Done& done) {
      const Index k = i / 2;
      if (i % 2 == 0) return has_all(k, [&](Index child) { return done[2 * child + 1] != 0; });
      const Index before = elder(k);
      return done[2 * k] != 0 && (before == -1 || done[2 * before + 1] != 0);
    };
    const auto go = [&](Index i, int member) {
      if (!positive) return;
      Stopwatch watch(member == 0 ? seconds : nullptr);
      double* const arena = memory + s_.left_size + own * static_cast<std::size_t>(member);
      if (i % 2 == 1) {
        hand_on(i / 2, blocks, shelf, watch);
      } else if (!eliminate(i / 2, blocks, shelf, arena, watch)) {
        positive = false;
      }
    };
    run(workspace, 2 * static_cast<Index>(s_.tasks.size()), ready, go);
    return positive;
  }

  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& workspace) const override {
    for (std::size_t begin = 0; begin < b.size(); begin += kMaxVectors) {
      const std::size_t count = std::min<std::size_t>(kMaxVectors, b.size() - begin);
      solve_some(b.subspan(begin, count), x.subspan(begin, count), workspace);
    }
  }

  std::size_t bytes() const override { return sizeof(*this) + factor_.bytes(); }

 private:
  /// Threads that work: one where there is one task.
  std::size_t members(CholeskyWorkspace& workspace) const {
    return s_.tasks.size() > 1 ? static_cast<std::size_t>(workspace.team().size()) : 1;
  }

  /// Run a loop over tasks on as many.
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

  /// Call visit(task) for the tasks whose roots are children of a supernode that joins them, in order.
  template <class Visit>
  void for_children(Index task, Visit visit) const {
    if (!s_.tasks[task].joins) return;
    const Supernode& node = root_of(task);
    for (Index c = node.children_begin; c < node.children_end; ++c) {
      visit(s_.supernodes[s_.children[c].supernode].task);
    }
  }

  /// Whether all of these tasks fulfill something.
  template <class Test>
  bool has_all(Index task, Test test) const {
    bool all = true;
    for_children(task, [&](Index child) { all = all && test(child); });
    return all;
  }

  /// The task before it among the children of their parent, or -1.
  Index elder(Index task) const {
    const Supernode& root = root_of(task);
    if (root.parent == -1 || root.as_child == s_.supernodes[root.parent].children_begin) return -1;
    return s_.supernodes[s_.children[root.as_child - 1].supernode].task;
  }

  /// Eliminate the supernodes of a task.
  ///
  /// @param arena  of the thread; behind it is scratch for the kernels
  bool eliminate(Index task, const double* blocks, Shelf& shelf, double* arena, Stopwatch& watch) {
    shelf.take(task);
    for (Index s = s_.tasks[task].begin; s < s_.tasks[task].end; ++s) {
      const Supernode& node = s_.supernodes[s];
      double* const u = &node == &root_of(task) ? shelf[task] : arena + node.update;
      if (!eliminate(node, blocks, shelf, arena, u, watch)) return false;
      if (&node != &root_of(task) && node.parent != -1) add_to_parent(node, blocks, u, watch);
    }
    for_children(task, [&](Index child) {
      if (left_size(root_of(child)) > 0) shelf.give_back(child, 0);
    });
    return true;
  }

  /// Add to the panel above a task what belongs there of the update matrix that it leaves.
  void hand_on(Index task, const double* blocks, Shelf& shelf, Stopwatch& watch) {
    const Supernode& root = root_of(task);
    if (root.parent == -1) return;
    add_to_parent(root, blocks, shelf[task], watch);
    shelf.give_back(task, left_size(root));
  }

  /// Finish a supernode's columns of L, which its children have added to, and find its update matrix.
  bool eliminate(const Supernode& node,
                 const double* blocks,
                 const Shelf& shelf,
                 double* arena,
                 double* u,
                 Stopwatch& watch) {
    if (node.children_begin == node.children_end) {
      assemble(node, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    // The update matrix is written before anything is added to it: it need not be cleared.
    double* const panel = factor_.data() + node.panel;
    if (!kernels_.factor(node.front, panel, u, arena + s_.arena_size)) return false;
    watch.lap(&CholeskySeconds::dense);
    if (node.parent == -1) return true;
    for (Index c = node.children_begin; c < node.children_end; ++c) {
      const Supernode& child = s_.supernodes[s_.children[c].supernode];
      const double* const of_child =
          child.task == node.task ? arena + child.update : shelf[child.task];
      kernels_.add_to_update(child.front, of_child, map_of(c), node.front, u);
    }
    watch.lap(&CholeskySeconds::extend_add);
    return true;
  }

  /// Add to the parent's panel what belongs there; the first child begins it.
  void add_to_parent(const Supernode& node,
                     const double* blocks,
                     const double* u,
                     Stopwatch& watch) {
    const Supernode& parent = s_.supernodes[node.parent];
    if (node.as_child == parent.children_begin) {
      assemble(parent, blocks);
      watch.lap(&CholeskySeconds::assembly);
    }
    kernels_.add_to_panel(node.front, u, map_of(node.as_child), parent.front,
                          factor_.data() + parent.panel);
    watch.lap(&CholeskySeconds::extend_add);
  }

  /// Size of what is left of the update matrix behind the columns that its parent's panel takes.
  std::size_t left_size(const Supernode& node) const {
    return s_.tasks[node.task].update - s_.taken_size(node);
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
      // Which are transposed is as good as random: no branch.
      const std::ptrdiff_t down = block.transposed != 0 ? 3 : 1;
      const std::ptrdiff_t across = 4 - down;
      for (int j = 0; j < 3; ++j) {
        for (int i = 0; i < 3; ++i) to[i + j * ld] = a[i * down + j * across];
      }
    }
  }

  ChildMap map_of(Index c) const {
    const Child& child = s_.children[c];
    return {.runs = s_.runs.data() + child.runs_begin,
            .column_runs = child.column_runs,
            .run_count = child.run_count};
  }

  /// Right-hand sides on their way through the factor, one vector after another.
  struct Vectors {
    std::span<const double* const> b;
    std::span<double* const> x;
    std::size_t n;          ///< length of y, in the order of elimination
    std::ptrdiff_t stride;  ///< length of a front
    double* y;
    double* passed;  ///< what tasks have to subtract from rows of others

    int count() const { return static_cast<int>(b.size()); }
  };

  void solve_some(std::span<const double* const> b,
                  std::span<double* const> x,
                  CholeskyWorkspace& workspace) const {
    const std::size_t n = 3 * s_.vertex.size();
    const auto longest = static_cast<std::size_t>(s_.longest);
    // Of each thread: vectors of its own, and behind them a front.
    const std::size_t own = (n + longest + kLine) / kLine * kLine;
    const std::size_t all = own * members(workspace);
    double* const memory = workspace.reserve(b.size() * (all + n + s_.passed_size));
    double* const y = memory + b.size() * all;
    const Vectors v{
        .b = b, .x = x, .n = n, .stride = s_.longest, .y = y, .passed = y + b.size() * n};
    const auto tasks = static_cast<Index>(s_.tasks.size());
    const auto ready = [&](Index k, const Team::Done& done) {
      if (k < tasks) return has_all(k, [&](Index child) { return done[child] != 0; });
      const Index task = 2 * tasks - 1 - k;
      const Index parent = s_.tasks[task].parent;
      return done[parent == -1 ? task : 2 * tasks - 1 - parent] != 0;
    };
    const auto go = [&](Index k, int member) {
      double* const front = memory + b.size() * own * static_cast<std::size_t>(member);
      if (k < tasks) {
        forward(k, v, front + b.size() * longest, front);
      } else {
        backward(2 * tasks - 1 - k, v, front);
      }
    };
    run(workspace, 2 * tasks, ready, go);
  }

  /// y := L^-1 y in the columns of a task.
  ///
  /// @param z  [n] vectors of the thread: the right side less what has been subtracted from it
  void forward(Index k, const Vectors& v, double* z, double* c) const {
    const Task& task = s_.tasks[k];
    const Supernode& root = root_of(k);
    for (int r = 0; r < v.count(); ++r) {
      double* const z_r = z + r * v.n;
      for (Index i = s_.supernodes[task.begin].first; i < root.first + root.columns; ++i) {
        std::copy_n(v.b[r] + 3 * static_cast<std::ptrdiff_t>(s_.vertex[i]), 3, z_r + 3 * i);
      }
      for (std::size_t i = root.rows_begin; i < root.rows_end; ++i) {
        std::fill_n(z_r + 3 * s_.rows[i], 3, 0.0);
      }
      for_children(k, [&](Index child) {
        add_rows(root_of(child), v.passed + r * s_.passed_size + s_.tasks[child].passed, z_r);
      });
    }
    for (Index s = task.begin; s < task.end; ++s) {
      const Supernode& node = s_.supernodes[s];
      const Front& f = node.front;
      for (int r = 0; r < v.count(); ++r) {
        double* const c_r = c + r * v.stride;
        std::fill_n(c_r, f.ld, 0.0);
        std::copy_n(z + r * v.n + 3 * node.first, f.columns, c_r);
      }
      kernels_.forward(f, factor_.data() + node.panel, c, v.stride, v.count());
      for (int r = 0; r < v.count(); ++r) {
        const double* const c_r = c + r * v.stride;
        std::copy_n(c_r, f.columns, v.y + r * v.n + 3 * node.first);
        add_rows(node, c_r + f.top, z + r * v.n);
      }
    }
    for (int r = 0; r < v.count(); ++r) {
      double* to = v.passed + r * s_.passed_size + task.passed;
      for (std::size_t i = root.rows_begin; i < root.rows_end; ++i, to += 3) {
        std::copy_n(z + r * v.n + 3 * s_.rows[i], 3, to);
      }
    }
  }

  /// to += values at the rows below a supernode.
  void add_rows(const Supernode& node, const double* values, double* to) const {
    for (std::size_t k = node.rows_begin; k < node.rows_end; ++k, values += 3) {
      for (int i = 0; i < 3; ++i) to[3 * s_.rows[k] + i] += values[i];
    }
  }

  /// x := L^-T y in the columns of a task.
  void backward(Index k, const Vectors& v, double* c) const {
    const Task& task = s_.tasks[k];
    for (Index s = task.end; s-- > task.begin;) {
      const Supernode& node = s_.supernodes[s];
      const Front& f = node.front;
      for (int r = 0; r < v.count(); ++r) {
        double* const c_r = c + r * v.stride;
        const double* const y_r = v.y + r * v.n;
        std::fill_n(c_r, f.ld, 0.0);
        std::copy_n(y_r + 3 * node.first, f.columns, c_r);
        double* below = c_r + f.top;
        for (std::size_t i = node.rows_begin; i < node.rows_end; ++i, below += 3) {
          std::copy_n(y_r + 3 * s_.rows[i], 3, below);
        }
      }
      kernels_.backward(f, factor_.data() + node.panel, c, v.stride, v.count());
      for (int r = 0; r < v.count(); ++r) {
        double* const y_r = v.y + r * v.n;
        std::copy_n(c + r * v.stride, f.columns, y_r + 3 * node.first);
        for (Index i = node.first; i < node.first + node.columns; ++i) {
          std::copy_n(y_r + 3 * i, 3, v.x[r] + 3 * static_cast<std::ptrdiff_t>(s_.vertex[i]));
        }
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
