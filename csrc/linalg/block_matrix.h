#pragma once

#include <array>
#include <memory>
#include <utility>
#include <vector>

#include "linalg/block_pattern.h"

namespace diffcloth::linalg {

/// Pairs (row, column) of a lower triangle, row > column.
using Couplings = std::vector<std::pair<Index, Index>>;

/// Sort couplings by (column, row), each once.
void sort_couplings(Couplings& pairs);

/// A base pattern enlarged by further couplings, and where the slots of the base went.
struct MergedPattern {
  BlockPattern pattern;
  std::vector<Index> slot_of_base;  ///< [base.block_count()]
};

/// Enlarge a pattern by sorted couplings.
MergedPattern merge(const BlockPattern& base, const Couplings& pairs);

/// A symmetric matrix over the cloth's vertices on a merged pattern.
///
/// Potentials with elements that never change add to the base pattern, whose slots they know; the
/// others add blocks by their vertices. Rows of fixed vertices exist in the base pattern only.
class BlockMatrix {
 public:
  /// @param fixed  [pattern size] vertices whose rows further couplings leave out
  BlockMatrix(std::shared_ptr<const MergedPattern> merged, const std::vector<char>& fixed);

  const BlockPattern& pattern() const { return merged_->pattern; }
  const double* blocks() const { return blocks_.data(); }
  double* blocks() { return blocks_.data(); }

  /// Add a matrix on the base pattern.
  void add_base(const std::vector<double>& base_blocks);

  /// Add value times I to the diagonal block of vertex i.
  void add_to_diagonal(Index i, double value) {
    double* block =
        blocks_.data() + 9 * static_cast<std::ptrdiff_t>(merged_->pattern.column_start()[i]);
    block[0] += value;
    block[4] += value;
    block[8] += value;
  }

  /// Whether vertex i has a row here that is not fixed.
  bool has(Index i) const { return i < merged_->pattern.size() && (*fixed_)[i] == 0; }

  /// Add the 12x12 matrix of four vertices, without the rows that are left out.
  void add_stencil(const std::array<Index, 4>& vertices, const Mat12& h);

  /// this = (this + s other) / (1 + s); both on the same pattern.
  void blend(const BlockMatrix& other, double s);

  /// y += A x.
  void add_product(const double* x, double* y) const;

 private:
  std::shared_ptr<const MergedPattern> merged_;
  const std::vector<char>* fixed_;
  std::vector<double> blocks_;
};

/// y += A x for a symmetric matrix given by its lower blocks on the pattern.
void add_product(const BlockPattern& pattern, const double* blocks, const double* x, double* y);

}  // namespace diffcloth::linalg
