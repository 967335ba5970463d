#pragma once

#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Elimination tree: the parent of a column of L is the first column it modifies. Columns are in
/// postorder.
struct EliminationTree {
  std::vector<Index> order;   ///< [n] k-th eliminated node
  std::vector<Index> rank;    ///< [n] inverse of `order`
  std::vector<Index> parent;  ///< [n] parent of the k-th, larger than k; -1 at a root
  std::vector<Index> height;  ///< [n] entries of column k of L, including the diagonal
};

/// Elimination tree of an order, which is replaced by an equivalent postorder.
EliminationTree eliminate(const Graph& graph, std::vector<Index> order);

}  // namespace diffcloth::linalg
