#pragma once

#include <cstddef>
#include <vector>

#include "linalg/backend.h"
#include "linalg/block_pattern.h"

namespace diffcloth::linalg {

/// Matrix of a block pattern in the format of libraries: the lower triangle of its scalars in the order
/// of elimination, in compressed columns.
struct ScalarMatrix {
  std::vector<Index> column_start;
  std::vector<Index> row;
  std::vector<Index> source;   ///< index of each scalar among the pattern's block values
  std::vector<Index> unknown;  ///< coordinate (3 vertex + axis) of each column

  explicit ScalarMatrix(const Elimination& elimination);

  Index dimension() const { return static_cast<Index>(unknown.size()); }
  std::size_t bytes() const;

  /// Gather the scalars from block values, in the order of `row`.
  void gather(const double* blocks, std::vector<double>& values) const;
};

}  // namespace diffcloth::linalg
