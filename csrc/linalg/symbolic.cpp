#include "linalg/symbolic.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "linalg/supernodes.h"

namespace diffcloth::linalg {
namespace {

/// Factorizations with fewer operations are one task; larger ones are split into subtrees of at most
/// this fraction of the operations, and the supernodes above.
constexpr double kWorthSplitting = 2e8;
constexpr double kLargestShare = 1.0 / 64;

/// Minimum length of columns whose stride is an odd number of cache lines, so that they map to different
/// cache sets.
constexpr Index kLongColumn = 128;

std::size_t size(const Trapezoid& matrix, Index columns) {
  return static_cast<std::size_t>(matrix.size(columns));
}

/// Operations of the elimination of a supernode.
double front_flops(const Front& front) {
  double flops = 0.0;
  for (Index j = 0; j < front.columns; ++j) {
    const double height = front.columns - j + front.rows;
    flops += height * height;
  }
  return flops;
}

/// Builds a Symbolic step by step.
class Analyzer {
 public:
  Analyzer(const BlockPattern& pattern,
           const Graph& graph,
           const EliminationTree& tree,
           Index lanes)
      : pattern_(pattern),
        graph_(graph),
        tree_(tree),
        lanes_(lanes),
        gathered_(gather_supernodes(tree)) {}

  Symbolic run() {
    place_columns();
    find_children();
    find_rows();
    lay_out_panels();
    sort_blocks();
    map_into_panels();
    split();
    lay_out_arenas();
    return std::move(s_);
  }

 private:
  Index padded(Index n) const { return (n + lanes_ - 1) / lanes_ * lanes_; }

  Index leading_dimension(Index n) const {
    return n >= kLongColumn && n % (2 * lanes_) == 0 ? n + lanes_ : n;
  }

  void place_columns() {
    const Index n = graph_.size();
    s_.vertex.resize(n);
    s_.diagonal.resize(n);
    rank_.assign(pattern_.size(), -1);
    for (Index k = 0; k < n; ++k) {
      s_.vertex[k] = graph_.vertex[tree_.order[gathered_.column[k]]];
      rank_[s_.vertex[k]] = k;
      s_.diagonal[k] = pattern_.column_start()[s_.vertex[k]];
    }
    s_.supernodes.resize(gathered_.size());
    owner_.resize(n);
    for (Index s = 0; s < gathered_.size(); ++s) {
      Supernode& node = s_.supernodes[s];
      node.first = gathered_.start[s];
      node.columns = gathered_.start[s + 1] - node.first;
      std::fill_n(owner_.begin() + node.first, node.columns, s);
    }
  }

  void find_children() {
    const Index count = gathered_.size();
    std::vector<Index> start(count + 1, 0);
    for (Index s = 0; s < count; ++s) {
      if (gathered_.parent[s] != -1) ++start[gathered_.parent[s] + 1];
    }
    for (Index s = 0; s < count; ++s) start[s + 1] += start[s];
    for (Index s = 0; s < count; ++s) {
      s_.supernodes[s].children_begin = start[s];
      s_.supernodes[s].children_end = start[s + 1];
    }
    s_.children.resize(start.back());
    for (Index s = 0; s < count; ++s) {
      Supernode& node = s_.supernodes[s];
      node.parent = gathered_.parent[s];
      if (node.parent == -1) continue;
      node.as_child = start[node.parent]++;
      s_.children[node.as_child].supernode = s;
    }
  }

  /// Rows below a supernode: rows of A's columns and of its children.
  void find_rows() {
    std::vector<Index> seen(graph_.size(), -1);
    for (Index s = 0; s < gathered_.size(); ++s) {
      Supernode& node = s_.supernodes[s];
      const Index end = node.first + node.columns;
      node.rows_begin = s_.rows.size();
      const auto take = [&](Index row) {
        if (row < end || seen[row] == s) return;
        seen[row] = s;
        s_.rows.push_back(row);
      };
      for (Index k = node.first; k < end; ++k) {
        const Index v = tree_.order[gathered_.column[k]];
        for (Index e = graph_.start[v]; e < graph_.start[v + 1]; ++e) {
          take(rank_[graph_.vertex[graph_.neighbor[e]]]);
        }
      }
      for (Index c = node.children_begin; c < node.children_end; ++c) {
        const Supernode& child = s_.supernodes[s_.children[c].supernode];
        for (std::size_t r = child.rows_begin; r < child.rows_end; ++r) take(s_.rows[r]);
      }
      node.rows_end = s_.rows.size();
      std::sort(s_.rows.begin() + static_cast<std::ptrdiff_t>(node.rows_begin), s_.rows.end());
    }
  }

  void lay_out_panels() {
    for (Supernode& node : s_.supernodes) {
      Front& front = node.front;
      front.columns = 3 * node.columns;
      front.rows = 3 * static_cast<Index>(node.rows_end - node.rows_begin);
      front.top = padded(front.columns);
      front.ld = leading_dimension(front.top + padded(front.rows));
      front.update_ld = leading_dimension(padded(front.rows));
      node.panel = s_.factor_size;
      s_.factor_size += size(front.panel(), front.columns);
      s_.longest = std::max(s_.longest, front.ld);
      for (Index j = 0; j < front.columns; ++j) {
        s_.nonzeros += static_cast<std::size_t>(front.columns - j + front.rows);
      }
      s_.flops += front_flops(front);
    }
  }

  /// Bucket sort of the slots by supernode.
  void sort_blocks() {
    std::vector<std::size_t> start(s_.supernodes.size() + 1, 0);
    const auto for_each_block = [&](auto visit) {
      for (Index j = 0; j < pattern_.size(); ++j) {
        if (rank_[j] < 0) continue;
        for (Index k = pattern_.column_start()[j]; k < pattern_.column_start()[j + 1]; ++k) {
          const Index i = pattern_.row()[k];
          if (rank_[i] >= 0) visit(k, rank_[i], rank_[j]);
        }
      }
    };
    for_each_block([&](Index, Index i, Index j) { ++start[owner_[std::min(i, j)] + 1]; });
    for (std::size_t s = 0; s < s_.supernodes.size(); ++s) {
      start[s + 1] += start[s];
      s_.supernodes[s].blocks_begin = start[s];
      s_.supernodes[s].blocks_end = start[s + 1];
    }
    s_.blocks.resize(start.back());
    for_each_block([&](Index slot, Index i, Index j) {
      const std::size_t k = start[owner_[std::min(i, j)]]++;
      s_.blocks[k] = {.slot = slot,
                      .row = std::max(i, j),
                      .column = std::min(i, j),
                      .place = 0,
                      .stride = 0,
                      .transposed = i < j};
    });
  }

  /// Locate blocks of the matrix and update matrices of children in each supernode.
  void map_into_panels() {
    std::vector<Index> position(graph_.size());  // among a supernode's columns, then its rows
    for (const Supernode& node : s_.supernodes) {
      for (Index k = 0; k < node.columns; ++k) position[node.first + k] = k;
      for (std::size_t r = node.rows_begin; r < node.rows_end; ++r) {
        position[s_.rows[r]] = node.columns + static_cast<Index>(r - node.rows_begin);
      }
      const Index padding = node.front.top - node.front.columns;
      for (std::size_t k = node.blocks_begin; k < node.blocks_end; ++k) {
        PlacedBlock& block = s_.blocks[k];
        const Index p = position[block.row];
        const Index row = p < node.columns ? 3 * p : 3 * p + padding;
        const Index column = 3 * (block.column - node.first);
        block.place = static_cast<Index>(node.front.panel().place(row, column));
        block.stride = static_cast<std::uint32_t>(node.front.panel().stride(column));
      }
      for (Index c = node.children_begin; c < node.children_end; ++c) {
        map_child(node, position, s_.children[c]);
      }
    }
  }

  void map_child(const Supernode& parent, const std::vector<Index>& position, Child& child) {
    const Supernode& node = s_.supernodes[child.supernode];
    child.runs_begin = s_.runs.size();
    child.column_runs = 0;
    Index previous = -2;
    for (std::size_t r = node.rows_begin; r < node.rows_end; ++r) {
      const Index to = position[s_.rows[r]];
      if (to != previous + 1 || to == parent.columns) {
        const bool is_column = to < parent.columns;
        if (is_column) ++child.column_runs;
        s_.runs.push_back({.from = 3 * static_cast<Index>(r - node.rows_begin),
                           .to = 3 * (is_column ? to : to - parent.columns),
                           .count = 0});
      }
      s_.runs.back().count += 3;
      previous = to;
    }
    child.run_count = static_cast<Index>(s_.runs.size() - child.runs_begin);
  }

  /// Operations of the subtree of each supernode.
  std::vector<double> subtree_flops() const {
    std::vector<double> flops(s_.supernodes.size(), 0.0);
    for (std::size_t s = 0; s < flops.size(); ++s) {
      const Supernode& node = s_.supernodes[s];
      flops[s] += front_flops(node.front);
      if (node.parent != -1) flops[node.parent] += flops[s];
    }
    return flops;
  }

  /// A task ends at the root of a subtree that is small enough while the parent's subtree is not.
  /// Separate trees share a task while they are small.
  void split() {
    const auto count = static_cast<Index>(s_.supernodes.size());
    const std::vector<double> flops = subtree_flops();
    const double largest = s_.flops < kWorthSplitting ? std::numeric_limits<double>::infinity()
                                                      : kLargestShare * s_.flops;
    const auto joins = [&](Index s) { return flops[s] > largest; };
    double trees = 0.0;  // operations of the whole trees in the current task
    for (Index s = 0, begin = 0; s < count; ++s) {
      Supernode& node = s_.supernodes[s];
      node.task = static_cast<Index>(s_.tasks.size());
      if (node.parent == -1) trees += flops[s];
      const bool ends = node.parent == -1 ? s + 1 == count || trees > 0.5 * largest || joins(s + 1)
                                          : joins(node.parent);
      if (!ends) continue;
      trees = 0.0;
      s_.tasks.push_back({.begin = begin,
                          .end = s + 1,
                          .parent = -1,
                          .joins = joins(s),
                          .update = size(node.front.update(), padded(node.front.rows)),
                          .passed = s_.passed_size});
      s_.left_size += s_.tasks.back().update;
      s_.passed_size += static_cast<std::size_t>(node.front.rows);
      begin = s + 1;
    }
    for (Task& task : s_.tasks) {
      const Index parent = s_.supernodes[task.end - 1].parent;
      if (parent != -1) task.parent = s_.supernodes[parent].task;
    }
  }

  /// First fit within each task, in the order of elimination, among the matrices of children that are
  /// alive. Offsets count from the end of the arena, because the last columns of a matrix stay alive
  /// longest. The update matrix of the root is stored elsewhere.
  void lay_out_arenas() {
    struct Extent {
      std::size_t begin, end;  // counted from the end of the arena
      Index supernode;
    };
    std::vector<Extent> alive;  // ascending
    for (const Task& task : s_.tasks) {
      alive.clear();
      for (Index s = task.begin; s < task.end; ++s) {
        Supernode& node = s_.supernodes[s];
        const bool is_left = s + 1 == task.end;
        const std::size_t wanted = is_left ? 0 : size(node.front.update(), padded(node.front.rows));
        std::size_t begin = 0;
        auto gap = alive.begin();
        for (; gap != alive.end() && gap->begin < begin + wanted; ++gap) begin = gap->end;
        node.update = begin + wanted;
        s_.arena_size = std::max(s_.arena_size, node.update);
        if (node.parent != -1 && !is_left) {
          // Its first columns are added to its parent's panel before the next supernode is eliminated.
          alive.insert(gap,
                       {.begin = begin, .end = node.update - s_.taken_size(node), .supernode = s});
        }
        std::erase_if(alive, [&](const Extent& e) { return gathered_.parent[e.supernode] == s; });
      }
    }
    for (Supernode& node : s_.supernodes) node.update = s_.arena_size - node.update;
  }

  const BlockPattern& pattern_;
  const Graph& graph_;
  const EliminationTree& tree_;
  Index lanes_;
  SupernodeTree gathered_;
  std::vector<Index> rank_;   // [pattern.size()] rank in the order of elimination, -1 if fixed
  std::vector<Index> owner_;  // [n] supernode of a column
  Symbolic s_;
};

}  // namespace

Symbolic analyze(const BlockPattern& pattern,
                 const Graph& graph,
                 const EliminationTree& tree,
                 Index lanes) {
  return Analyzer(pattern, graph, tree, lanes).run();
}

std::size_t Symbolic::taken_size(const Supernode& node) const {
  const Child& child = children[node.as_child];
  const Run& last = runs[child.runs_begin + child.column_runs - 1];
  return size(node.front.update(), last.from + last.count);
}

std::size_t Symbolic::bytes() const {
  return sizeof(Symbolic) + (vertex.capacity() + diagonal.capacity()) * sizeof(Index) +
         supernodes.capacity() * sizeof(Supernode) + rows.capacity() * sizeof(Index) +
         blocks.capacity() * sizeof(PlacedBlock) + children.capacity() * sizeof(Child) +
         runs.capacity() * sizeof(Run) + tasks.capacity() * sizeof(Task);
}

}  // namespace diffcloth::linalg
