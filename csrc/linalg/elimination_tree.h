#pragma once

#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Which column of L each column modifies first, for nodes eliminated in a postorder of that tree.
struct EliminationTree {
  std::vector<Index> order;   ///< [n] node eliminated k-th
  std::vector<Index> rank;    ///< [n] its inverse
  std::vector<Index> parent;  ///< [n] of the k-th, -1 at a root; larger than k
  std::vector<Index> height;  ///< [n] entries of column k of L, the diagonal included
};

/// The tree for an order of elimination, which is replaced by an equivalent postorder.
EliminationTree eliminate(const Graph& graph, std::vector<Index> order);

}  // namespace diffcloth::linalg
