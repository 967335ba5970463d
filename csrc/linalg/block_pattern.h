#pragma once

#include <span>
#include <utility>
#include <vector>

#include "common/types.h"

namespace diffcloth::linalg {

/// Sparsity pattern of the 3x3 blocks of a symmetric matrix over n vertices.
///
/// Only the lower triangle is stored (row >= column), column by column, rows ascending; every diagonal
/// block is present. The slot of a block is its index in that order, and a matrix on the pattern is a
/// flat array of 9 doubles a slot (column-major blocks).
class BlockPattern {
 public:
  BlockPattern() = default;

  /// Pattern in which the vertices of each clique are coupled with each other.
  BlockPattern(Index vertex_count, const std::vector<std::vector<Index>>& cliques);

  /// Pattern from finished columns: see column_start() and row().
  BlockPattern(std::vector<Index> column_start, std::vector<Index> row)
      : column_start_(std::move(column_start)), row_(std::move(row)) {}

  /// Pattern from lower-triangle (row, column) pairs with row >= column, in any order, repeated or
  /// not. The diagonal is added.
  static BlockPattern from_pairs(Index vertex_count, std::vector<std::pair<Index, Index>> pairs);

  Index size() const { return static_cast<Index>(column_start_.size()) - 1; }
  Index block_count() const { return static_cast<Index>(row_.size()); }

  /// Slots of column j are column_start()[j] .. column_start()[j + 1] - 1, the diagonal first.
  const std::vector<Index>& column_start() const { return column_start_; }
  const std::vector<Index>& row() const { return row_; }

  /// Slot of block (i, j) with i >= j. The block must be in the pattern.
  Index slot(Index i, Index j) const;

  /// Slots of all pairs (p, q), p >= q, of a clique, in the order (0,0), (1,0), (1,1), (2,0) ... The
  /// block of a pair is stored at (max, min) of its two vertices: it is the transpose of the element's
  /// block (p, q) if clique[p] < clique[q].
  std::vector<Index> slots(std::span<const Index> clique) const;

  friend bool operator==(const BlockPattern&, const BlockPattern&) = default;

 private:
  std::vector<Index> column_start_{0};
  std::vector<Index> row_;
};

/// Index of the lower-triangle pair (p, q), p >= q, in the order of slots().
constexpr Index lower(Index p, Index q) { return p * (p + 1) / 2 + q; }

/// Add an element's block (p, q), p >= q, to a matrix on the pattern, transposed if the vertices are
/// stored in the opposite order.
template <class Block>
inline void add_block(double* values, Index slot, bool transposed, const Block& block) {
  Eigen::Map<Mat3> target(values + 9 * static_cast<std::ptrdiff_t>(slot));
  if (transposed) {
    target += block.transpose();
  } else {
    target += block;
  }
}

}  // namespace diffcloth::linalg
