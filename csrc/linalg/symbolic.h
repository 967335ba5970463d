#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "linalg/block_pattern.h"
#include "linalg/dense_kernels.h"
#include "linalg/elimination_tree.h"
#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Consecutive columns of L that are stored as one dense panel, and where everything of it lies.
struct Supernode {
  Front front;
  Index first;               ///< its first column, in vertices
  Index columns;             ///< vertices
  std::size_t rows_begin;    ///< its rows below: Symbolic::rows[rows_begin .. rows_end - 1]
  std::size_t rows_end;      ///<
  std::size_t panel;         ///< offset in the factor
  std::size_t update;        ///< offset of its update matrix in its task's arena
  std::size_t blocks_begin;  ///< its blocks of A: Symbolic::blocks[blocks_begin .. blocks_end - 1]
  std::size_t blocks_end;
  Index children_begin;  ///< its children: Symbolic::children[children_begin .. children_end - 1]
  Index children_end;
  Index parent;    ///< -1 at a root
  Index as_child;  ///< which of Symbolic::children it is
  Index task;      ///< which of Symbolic::tasks it belongs to
};

/// A block of the matrix: its slot, its row and column in the order of elimination, its place in the
/// panel, how far columns are apart there, and whether it stands there transposed.
struct PlacedBlock {
  Index slot;
  Index row;
  Index column;
  Index place;
  std::uint32_t stride : 31;
  std::uint32_t transposed : 1;
};

/// A child of a supernode: how its update matrix falls into its parent's matrices, in scalars.
struct Child {
  Index supernode;
  std::size_t runs_begin;
  Index column_runs;
  Index run_count;
};

/// Consecutive supernodes that one thread eliminates: a subtree, or a single one above subtrees. The
/// last is the root of the others, or one of several trees.
struct Task {
  Index begin;  ///< its supernodes: Symbolic::supernodes[begin .. end - 1]
  Index end;
  Index parent;        ///< -1 where it has none
  bool joins;          ///< a single supernode, whose children are roots of other tasks
  std::size_t update;  ///< size of the update matrix that it leaves to its parent
  std::size_t passed;  ///< offset of what its rows below get in a solve
};

/// All of A = L L^T that does not depend on values, for the multifrontal method. Sizes and offsets count
/// numbers, of whose precision the layout depends.
///
/// Vertices are eliminated in a postorder of the tree of supernodes. Of the update matrix of a
/// supernode its parent's panel takes at once what belongs there; the rest is alive until the parent
/// has added it to its own. Those of a task share one arena at offsets that are found here, once. The
/// root of a task leaves all of it to another task. Each entry is summed in the order of the children,
/// whatever thread does it.
struct Symbolic {
  std::vector<Index> vertex;    ///< [n] vertex eliminated k-th
  std::vector<Index> diagonal;  ///< [n] slot of its diagonal block
  std::vector<Supernode> supernodes;
  std::vector<Index> rows;  ///< vertices in the order of elimination, ascending in each supernode
  std::vector<PlacedBlock> blocks;
  std::vector<Child> children;
  std::vector<Run> runs;
  std::vector<Task> tasks;      ///< children before their parents
  std::size_t factor_size = 0;  ///< of all panels
  std::size_t arena_size = 0;   ///< that of the largest task
  std::size_t left_size = 0;    ///< of all update matrices that tasks leave
  std::size_t passed_size = 0;  ///< of what tasks pass on in a solve
  std::size_t nonzeros = 0;     ///< of L, zeros that supernodes store included, padding not
  double flops = 0.0;           ///< of one factorization, for those nonzeros
  Index longest = 0;            ///< largest ld of a panel

  /// Size of the columns of an update matrix that are columns of the parent, the first ones.
  std::size_t taken_size(const Supernode& node) const;

  std::size_t bytes() const;
};

/// @param lanes  numbers in a cache line, which rows are padded to
Symbolic analyze(const BlockPattern& pattern,
                 const Graph& graph,
                 const EliminationTree& tree,
                 Index lanes);

}  // namespace diffcloth::linalg
