#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::linalg {

/// Number of columns that are factored before they update later ones, so that the working set stays in
/// the cache.
constexpr int kColumnBlock = 96;

/// Number of vectors that the kernels for many vectors process at once.
constexpr int kMaxVectors = 8;

/// Number of vectors for the next call, of `left` remaining: few are processed one at a time, which is
/// as fast.
constexpr std::size_t at_once(std::size_t left) {
  constexpr std::size_t kFew = 4;
  return left <= kFew ? 1 : left < kMaxVectors ? left : kMaxVectors;
}

/// Storage of the columns of a lower triangle and of the rows below it: column-major in blocks of
/// kColumnBlock columns, each without the rows above its part of the triangle. Always inlined, because
/// files compiled for different instructions share the class.
struct Trapezoid {
  std::int32_t ld;  ///< leading dimension of the first block

  /// First column of a column's block, which is also the block's first row.
  [[gnu::always_inline]] static constexpr std::int32_t first(std::int32_t column) {
    return column / kColumnBlock * kColumnBlock;
  }

  /// Leading dimension of a column's block.
  [[gnu::always_inline]] constexpr std::ptrdiff_t stride(std::int32_t column) const {
    return ld - first(column);
  }

  /// Offset of an entry. Row 0 is valid for address arithmetic even if it is not stored.
  [[gnu::always_inline]] constexpr std::ptrdiff_t place(std::int32_t row,
                                                        std::int32_t column) const {
    const std::ptrdiff_t block = first(column);
    const std::ptrdiff_t before = block * ld - block * (block - kColumnBlock) / 2;
    return before + (column - block) * (ld - block) + row - block;
  }

  /// Size of the first `columns` columns.
  [[gnu::always_inline]] constexpr std::ptrdiff_t size(std::int32_t columns) const {
    return place(first(columns), columns);
  }
};

/// Shape of a supernode's dense matrices, in scalars.
///
/// The panel [ld, columns] holds the supernode's columns of L: the lower triangle of its own rows first,
/// `top` of them with padding, then the rows below. The update matrix [update_ld, rows] is its
/// contribution to its ancestors. Both are trapezoids, of which only the lower triangle is meaningful.
/// `top`, ld and update_ld are multiples of a pack, and padding in the panel is zero.
struct Front {
  std::int32_t columns;
  std::int32_t rows;
  std::int32_t top;
  std::int32_t ld;
  std::int32_t update_ld;

  [[gnu::always_inline]] constexpr Trapezoid panel() const { return {.ld = ld}; }
  [[gnu::always_inline]] constexpr Trapezoid update() const { return {.ld = update_ld}; }
};

/// Consecutive rows of a child's update matrix that are also consecutive in its parent.
struct Run {
  std::int32_t from;   ///< first row in the child's update matrix
  std::int32_t to;     ///< first column of the parent, or row of its update matrix
  std::int32_t count;  ///< number of rows
};

/// Map of a child's update matrix into its parent: runs of rows, ascending. The first column_runs go to
/// the parent's columns, the others to the rows below.
struct ChildMap {
  const Run* runs;
  std::int32_t column_runs;
  std::int32_t run_count;
};

/// Number type of a factor.
enum class Precision : std::uint8_t { kDouble, kSingle };

/// Positive definiteness of a matrix, as far as its factorization can determine it.
enum class Verdict : std::uint8_t {
  kPositive,
  kIndefinite,  ///< or not finite
  kUnclear,     ///< a pivot in single precision is within rounding of zero
};

/// The dense arithmetic of the multifrontal factorization, in double or single precision.
///
/// Every entry is summed in one order, whatever the level: c_ij -= a_ik b_jk for k = 0, 1, ... with one
/// rounding each. Levels with fused multiply-add (all but kPortable on x86-64) therefore agree in every
/// bit. A pack of numbers is a cache line: eight doubles or sixteen floats.
template <class Real>
struct FrontKernels {
  /// Compute L in place of the panel, with 1 / l_jj on the diagonal, and U = -L_2 L_2^T, where L_2 are
  /// the rows below the triangle. Stops at a pivot that is not positive and finite, or, in single
  /// precision, below 2^-16 (the diagonal of the scaled matrix is between 1 and 4).
  ///
  /// @param u        [update_ld, rows up to a multiple of a pack], may be uninitialized
  /// @param scratch  [kColumnBlock ld]
  Verdict (*factor)(const Front& front, Real* panel, Real* u, Real* scratch);

  /// Add those columns of a child's update matrix that are columns of the parent.
  void (*add_to_panel)(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* panel);

  /// Add the other columns of a child's update matrix.
  void (*add_to_update)(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* parent_u);

  /// c_1 := L_1^-1 c_1, c_2 := c_2 - L_2 c_1; c_2 begins at `top`, padding is zero.
  void (*forward)(const Front& front, const Real* panel, Real* c);

  /// c_1 := L_1^-T (c_1 - L_2^T c_2), in the same layout.
  void (*backward)(const Front& front, const Real* panel, Real* c);

  /// Same for kMaxVectors interleaved vectors, each with the same bits as alone.
  void (*forward_many)(const Front& front, const Real* panel, Real* c);
  void (*backward_many)(const Front& front, const Real* panel, Real* c);
};

/// y += A x for a symmetric matrix given by its lower 3x3 blocks on a BlockPattern. All levels return
/// identical bits.
using MultiplyBlocks = void (*)(const std::int32_t* column_start,
                                const std::int32_t* row,
                                std::int32_t size,
                                const double* blocks,
                                const double* x,
                                double* y);

/// All dense kernels of a level.
struct DenseKernels {
  MultiplyBlocks multiply_blocks;  ///< x and y have four numbers a row; the last is padding
  MultiplyBlocks
      multiply_blocks_many;  ///< three a row, for kMaxVectors vectors each; same bits as for one
  FrontKernels<double> doubles;
  FrontKernels<float> floats;
};

/// The kernels of a supported level.
const DenseKernels& dense_kernels(KernelLevel level);

}  // namespace diffcloth::linalg
