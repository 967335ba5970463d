#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "linalg/block_pattern.h"
#include "linalg/dense_kernels.h"
#include "linalg/elimination_tree.h"
#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Consecutive columns of L that are stored as one dense panel, with the offsets of all its data.
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
  Index as_child;  ///< index in Symbolic::children
  Index task;      ///< index in Symbolic::tasks
};

/// A block of the matrix: slot, row and column in the order of elimination, offset in the panel, leading
/// dimension there, and true if it is stored transposed.
struct PlacedBlock {
  Index slot;
  Index row;
  Index column;
  Index place;
  std::uint32_t stride : 31;
  std::uint32_t transposed : 1;
};

/// A child of a supernode, with the map of its update matrix into its parent's matrices, in scalars.
struct Child {
  Index supernode;
  std::size_t runs_begin;
  Index column_runs;
  Index run_count;
};

/// Consecutive supernodes that one thread eliminates: a subtree, several whole trees, or a single
/// supernode above subtrees. The last supernode is the root (of the last tree).
struct Task {
  Index begin;  ///< its supernodes: Symbolic::supernodes[begin .. end - 1]
  Index end;
  Index parent;        ///< -1: none
  bool joins;          ///< true for a single supernode whose children are roots of other tasks
  std::size_t update;  ///< size of the update matrix of its root
  std::size_t passed;  ///< offset of its updates to rows below in a solve
};

/// Symbolic data of A = L L^T for the multifrontal method. Sizes and offsets count numbers; the layout
/// depends on their precision.
///
/// Vertices are eliminated in a postorder of the tree of supernodes. The first columns of a supernode's
/// update matrix are added to its parent's panel at once; the rest is alive until the parent has added
/// it to its own update matrix. Update matrices inside a task share one arena, at offsets computed here
/// once. The whole update matrix of a task's root is stored separately, for another task. Each entry is
/// summed in the order of the children, on whichever thread.
struct Symbolic {
  std::vector<Index> vertex;    ///< [n] k-th eliminated vertex
  std::vector<Index> diagonal;  ///< [n] slot of its diagonal block
  std::vector<Supernode> supernodes;
  std::vector<Index> rows;  ///< vertices in the order of elimination, ascending in each supernode
  std::vector<PlacedBlock> blocks;
  std::vector<Child> children;
  std::vector<Run> runs;
  std::vector<Task> tasks;      ///< children before their parents
  std::size_t factor_size = 0;  ///< size of all panels
  std::size_t arena_size = 0;   ///< size of the largest task's arena
  std::size_t left_size = 0;    ///< size of all update matrices of task roots
  std::size_t passed_size = 0;  ///< size of the updates passed between tasks in a solve
  std::size_t nonzeros = 0;     ///< entries of L, with zeros stored in supernodes, without padding
  double flops = 0.0;           ///< operations of one factorization, for those nonzeros
  Index longest = 0;            ///< largest ld of a panel

  /// Size of the leading columns of an update matrix that are columns of the parent.
  std::size_t taken_size(const Supernode& node) const;

  std::size_t bytes() const;
};

/// @param lanes  numbers in a cache line; rows are padded to a multiple
Symbolic analyze(const BlockPattern& pattern,
                 const Graph& graph,
                 const EliminationTree& tree,
                 Index lanes);

}  // namespace diffcloth::linalg
