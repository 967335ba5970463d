#pragma once

#include <vector>

#include "linalg/block_pattern.h"

namespace diffcloth::linalg {

/// Couplings of the unknown vertices of a pattern: an undirected graph without loops.
struct Graph {
  std::vector<Index> start;     ///< [size + 1] neighbors of node k: start[k] .. start[k + 1] - 1
  std::vector<Index> neighbor;  ///< ascending for each node
  std::vector<Index> vertex;    ///< [size] vertex of the pattern for each node, ascending

  Index size() const { return static_cast<Index>(vertex.size()); }
};

/// Graph of the vertices that are not fixed.
Graph unknown_graph(const BlockPattern& pattern, const std::vector<char>& fixed);

}  // namespace diffcloth::linalg
