#pragma once

#include <algorithm>
#include <array>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "common/recycled_memory.h"
#include "linalg/attachments.h"
#include "linalg/block_pattern.h"
#include "linalg/stencil_kernels.h"

namespace diffcloth::linalg {

/// Pairs (row, column) of a lower triangle, row > column.
using Couplings = std::vector<std::pair<Index, Index>>;

/// Couplings that are not in the base pattern, by (column, row), each once.
Couplings beyond(const BlockPattern& base, const Couplings& pairs);

/// A base pattern enlarged by further couplings, with the new slots of the base's blocks.
struct MergedPattern {
  BlockPattern pattern;
  std::vector<Index> slot_of_base;  ///< [base.block_count()]
};

/// Enlarge a pattern by sorted couplings.
MergedPattern merge(const BlockPattern& base, const Couplings& pairs);

/// Symmetric matrix on a merged pattern, stored by its lower blocks.
class BlockValues {
 public:
  const BlockPattern& pattern() const { return merged_->pattern; }
  const double* blocks() const { return blocks_.data(); }
  double* blocks() { return blocks_.data(); }

  /// y += A x.
  void add_product(const double* x, double* y) const;

  /// y_k += A x_k for several vectors, each with the same bits as alone.
  void add_products(std::span<const double* const> x, std::span<double* const> y) const;

  /// Memory of the values, without the pattern.
  std::size_t bytes() const { return blocks_.capacity() * sizeof(double); }

 protected:
  explicit BlockValues(std::shared_ptr<const MergedPattern> merged)
      : merged_(std::move(merged)),
        blocks_(9 * static_cast<std::size_t>(merged_->pattern.block_count()), 0.0) {}

  std::shared_ptr<const MergedPattern> merged_;
  std::vector<double, RecyclingAllocator<double>> blocks_;
};

/// Matrix under assembly, whose rows are the cloth's vertices followed by nodes of coordinates.
///
/// Potentials with constant elements add to the slots of the base pattern, which they store. Other
/// potentials add blocks by point; points without rows may be attached to rows. Rows of fixed points
/// exist in the base pattern only.
class BlockMatrix : public BlockValues {
 public:
  /// @param fixed        [pattern size] rows without further couplings
  /// @param attachments  of the points without rows; null if every point is a row
  BlockMatrix(std::shared_ptr<const MergedPattern> merged,
              const std::vector<char>& fixed,
              const Attachments* attachments = nullptr);

  /// Slots of the base pattern's blocks in blocks().
  const std::vector<Index>& slot_of_base() const { return merged_->slot_of_base; }

  /// Add value times I to the diagonal block of vertex i.
  void add_to_diagonal(Index i, double value) {
    double* block =
        blocks_.data() + 9 * static_cast<std::ptrdiff_t>(merged_->pattern.column_start()[i]);
    block[0] += value;
    block[4] += value;
    block[8] += value;
  }

  /// Add a diagonal to the diagonal block of row i.
  void add_to_diagonal(Index i, const Vec3& values) {
    double* block =
        blocks_.data() + 9 * static_cast<std::ptrdiff_t>(merged_->pattern.column_start()[i]);
    for (int a = 0; a < 3; ++a) block[4 * a] += values[a];
  }

  /// Add a block at rows i >= j, and its transpose at (j, i).
  void add_block(Index i, Index j, const Mat3& block) {
    Eigen::Map<Mat3>(blocks_.data() +
                     9 * static_cast<std::ptrdiff_t>(merged_->pattern.slot(i, j))) += block;
  }

  /// Add the matrix of a few points, each of which may be a row; rows of fixed points are left out.
  ///
  /// @param block  (p, q) -> its 3x3 block; called only for blocks that are added: for points of bodies
  /// often one of sixteen
  template <class Block>
  void add_rows(std::span<const Index> points, Block&& block) {
    const auto count = static_cast<int>(points.size());
    for (int p = 0; p < count; ++p) {
      const Index i = points[p];
      if (!has(i)) continue;
      for (int q = 0; q < count; ++q) {
        const Index j = points[q];
        if (i >= j && has(j)) add_block(i, j, block(p, q));
      }
    }
  }

  /// Add a matrix given by its factors; rows as in add_rows().
  void add_terms(std::span<const Index> points, const StencilTerms& of);

  /// Add the 12x12 matrix of four points, some of which may be attached.
  template <class Block>
  void add_stencil(const std::array<Index, 4>& points, Block&& block) {
    if (any_attached(points)) {
      add_attached(points, all_blocks(block));
    } else {
      add_rows(points, block);
    }
  }

  /// Add B^T core B, where B dx is the sum of jacobian dx over a few points.
  void add_congruence(std::span<const Index> points,
                      std::span<const Mat3> jacobians,
                      const Mat3& core);

  /// True if any of the points is attached to rows.
  bool any_attached(std::span<const Index> points) const {
    return attachments_ != nullptr &&
           std::ranges::any_of(points, [&](Index v) { return is_attached(v); });
  }

  /// True if any of the points is a row here, or attached to rows.
  bool has_any(std::span<const Index> points) const {
    return std::ranges::any_of(points, [&](Index v) { return has(v) || is_attached(v); });
  }

  /// this = (this + s other) / (1 + s); both on the same pattern.
  void blend(const BlockMatrix& other, double s);

 private:
  /// True if a point is a row here that is not fixed.
  bool has(Index point) const {
    const Index rows = attachments_ == nullptr ? merged_->pattern.size() : attachments_->first;
    return point < rows && (*fixed_)[point] == 0;
  }
  bool is_attached(Index point) const {
    return attachments_ != nullptr && !attachments_->empty() && point >= attachments_->first &&
           attachments_->begin(point) != attachments_->end(point);
  }
  void add_attached(const std::array<Index, 4>& points, const Mat12& h);

  /// Motion of four points with a row: dx = g dz, or the identity for one point if it is the row.
  struct Motion {
    Index row;
    int point;  ///< index among the four; -1: see g
    Eigen::Matrix<double, 12, 3> g;
  };

  const std::vector<char>* fixed_;
  const Attachments* attachments_;
  std::vector<Motion> motions_;                  // scratch of add_attached
  std::vector<std::pair<Index, Mat3>> changes_;  // scratch of add_congruence: B by row
};

/// y += A x for a symmetric matrix given by its lower blocks on the pattern, and several vectors.
void add_products(const BlockPattern& pattern,
                  const double* blocks,
                  std::span<const double* const> x,
                  std::span<double* const> y);

}  // namespace diffcloth::linalg
