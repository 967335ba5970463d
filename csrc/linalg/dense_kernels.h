#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::linalg {

/// Columns that are factored before later ones see them: what they need at a time stays in the cache.
constexpr int kColumnBlock = 96;

/// Vectors that kernels for many take at once.
constexpr int kMaxVectors = 8;

/// How many of some vectors that are left take one call: where they are few, one at a time is as fast.
constexpr std::size_t at_once(std::size_t left) {
  constexpr std::size_t kFew = 4;
  return left <= kFew ? 1 : left < kMaxVectors ? left : kMaxVectors;
}

/// How the columns of a lower triangle, and of rows below it, are stored: column-major in blocks of
/// kColumnBlock columns, each without the rows above its part of the triangle. Always inlined, as
/// files that are compiled for different instructions share it.
struct Trapezoid {
  std::int32_t ld;  ///< leading dimension of the first block

  /// First column of a column's block, and its first row.
  [[gnu::always_inline]] static constexpr std::int32_t first(std::int32_t column) {
    return column / kColumnBlock * kColumnBlock;
  }

  /// Leading dimension of a column's block.
  [[gnu::always_inline]] constexpr std::ptrdiff_t stride(std::int32_t column) const {
    return ld - first(column);
  }

  /// Offset of an entry; of row 0 also where that is not stored, to count from.
  [[gnu::always_inline]] constexpr std::ptrdiff_t place(std::int32_t row,
                                                        std::int32_t column) const {
    const std::ptrdiff_t block = first(column);
    const std::ptrdiff_t before = block * ld - block * (block - kColumnBlock) / 2;
    return before + (column - block) * (ld - block) + row - block;
  }

  /// Size of so many columns.
  [[gnu::always_inline]] constexpr std::ptrdiff_t size(std::int32_t columns) const {
    return place(first(columns), columns);
  }
};

/// Shape of a supernode's dense matrices, in scalars.
///
/// The panel [ld, columns] holds the supernode's columns of L: the lower triangle of its own rows
/// first, `top` of them with padding, then the rows below. The update matrix [update_ld, rows] is
/// what it subtracts from its ancestors. Both are trapezoids, of which only the lower triangle means
/// anything. `top`, ld and update_ld are multiples of a pack, and padding in the panel is zero.
struct Front {
  std::int32_t columns;
  std::int32_t rows;
  std::int32_t top;
  std::int32_t ld;
  std::int32_t update_ld;

  [[gnu::always_inline]] constexpr Trapezoid panel() const { return {.ld = ld}; }
  [[gnu::always_inline]] constexpr Trapezoid update() const { return {.ld = update_ld}; }
};

/// Consecutive rows of a child's update matrix that are consecutive in its parent, too.
struct Run {
  std::int32_t from;   ///< first row in the child's update matrix
  std::int32_t to;     ///< first column of the parent, or row of its update matrix
  std::int32_t count;  ///< how many
};

/// Where the rows of a child's update matrix belong in its parent: runs, ascending. The first ones
/// go to the parent's columns, the others to the rows below them.
struct ChildMap {
  const Run* runs;
  std::int32_t column_runs;
  std::int32_t run_count;
};

/// Of the numbers of a factor.
enum class Precision : std::uint8_t { kDouble, kSingle };

/// Whether a matrix is positive definite, as far as its factorization can tell.
enum class Verdict : std::uint8_t {
  kPositive,
  kIndefinite,  ///< or not finite
  kUnclear,     ///< a pivot in single precision is too small to be told from rounding
};

/// The dense arithmetic of the multifrontal factorization, in double or single precision.
///
/// Every entry is summed in one order, whatever the level: c_ij -= a_ik b_jk for k = 0, 1, ... with
/// one rounding each. Levels with fused multiply-add (all but kPortable on x86-64) therefore agree
/// in every bit. Numbers are taken in packs of a cache line: eight doubles or sixteen floats.
template <class Real>
struct FrontKernels {
  /// L of the panel in place, 1 / l_jj on the diagonal, and U = -L_2 L_2^T, where L_2 are the rows
  /// below the triangle. It ends at once at a pivot that is not positive and finite, or, in single
  /// precision, below 2^-16: there the diagonal of the matrix is between 1 and 4.
  ///
  /// @param u        [update_ld, rows up to a multiple of a pack], need not be initialized
  /// @param scratch  [kColumnBlock ld]
  Verdict (*factor)(const Front& front, Real* panel, Real* u, Real* scratch);

  /// Add the columns of a child's update matrix that are columns of the parent.
  void (*add_to_panel)(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* panel);

  /// Add the other columns of a child's update matrix.
  void (*add_to_update)(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* parent_u);

  /// c_1 := L_1^-1 c_1, c_2 := c_2 - L_2 c_1; c_2 begins at `top`, entries of padding are zero.
  void (*forward)(const Front& front, const Real* panel, Real* c);

  /// c_1 := L_1^-T (c_1 - L_2^T c_2), in the same layout.
  void (*backward)(const Front& front, const Real* panel, Real* c);

  /// The same for kMaxVectors vectors, entry by entry, each with the bits that it has alone.
  void (*forward_many)(const Front& front, const Real* panel, Real* c);
  void (*backward_many)(const Front& front, const Real* panel, Real* c);
};

/// y += A x for a symmetric matrix given by its lower 3x3 blocks on a BlockPattern. The same bits on every
/// level.
using MultiplyBlocks = void (*)(const std::int32_t* column_start,
                                const std::int32_t* row,
                                std::int32_t size,
                                const double* blocks,
                                const double* x,
                                double* y);

/// All dense kernels of a level.
struct DenseKernels {
  MultiplyBlocks multiply_blocks;  ///< x and y have four numbers a row, the last means nothing
  MultiplyBlocks
      multiply_blocks_many;  ///< three, and each kMaxVectors times, with the bits of one alone
  FrontKernels<double> doubles;
  FrontKernels<float> floats;
};

/// The kernels of a supported level.
const DenseKernels& dense_kernels(KernelLevel level);

}  // namespace diffcloth::linalg
