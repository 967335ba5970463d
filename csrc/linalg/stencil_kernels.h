#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::linalg {

/// Number of points of the largest stencil.
inline constexpr int kStencilPoints = 5;

// Plain arrays and pointers: std::array is a template, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Factors of the symmetric matrix of a few points:
///
///   sum_k left_k right_k^T + along c c^T (x) I + rest + cross product of two edges with `turn`,
///
/// where `right` may be `left` times a core. Vectors have three numbers a point; vectors of five points
/// are padded to sixteen.
struct StencilTerms {
  int count = 4;                 ///< number of points: four or five
  int terms = 0;                 ///< number of outer products: at most three
  const double* left[3] = {};    ///< [12] or [16]
  const double* right[3] = {};   ///< likewise; without a core
  const double* core = nullptr;  ///< [3, 3], symmetric: right_k = sum_m core_km left_m; null: none
  double along = 0.0;            ///< with four points only
  const double* c = nullptr;     ///< [4]
  const double* rest = nullptr;  ///< [12, 12], with four points; null: none
  const double* turn = nullptr;  ///< [3]: cross product between both edges; null: none
  double sign[2][kStencilPoints]{};  ///< coefficient of each point in each edge
};

/// Add the blocks of the matrix to a matrix on a pattern (see BlockPattern).
///
/// The kernel uses sums and products only, each rounded once, in one order: identical bits at every
/// level.
///
/// @param row    [count] distinct rows of the points; negative: no row
/// @param start  column starts of the pattern
/// @param rows   row indices of the pattern
using AddStencil = void (*)(const StencilTerms& of,
                            const std::int32_t* row,
                            const std::int32_t* start,
                            const std::int32_t* rows,
                            double* blocks);

// NOLINTEND(modernize-avoid-c-arrays)

/// @throws std::invalid_argument  if this processor or build does not support the level
AddStencil stencil_kernel(KernelLevel level);

}  // namespace diffcloth::linalg
