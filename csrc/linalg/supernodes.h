#pragma once

#include <vector>

#include "linalg/elimination_tree.h"

namespace diffcloth::linalg {

/// Columns of an elimination tree gathered into supernodes, children before parents.
struct SupernodeTree {
  std::vector<Index> column;  ///< [n] columns of the elimination tree in their new order
  std::vector<Index> start;   ///< [count + 1] supernode s has column[start[s] .. start[s + 1] - 1]
  std::vector<Index> parent;  ///< [count] -1 at a root

  Index size() const { return static_cast<Index>(parent.size()); }
};

/// Gather columns of equal structure, then merge children into parents if few zeros result: larger
/// panels cost less per entry.
SupernodeTree gather_supernodes(const EliminationTree& tree);

}  // namespace diffcloth::linalg
