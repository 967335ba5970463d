#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::linalg {

/// Points of the largest stencil.
inline constexpr int kStencilPoints = 5;

// Plain arrays and pointers: those of the standard library are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// The symmetric matrix of a few points, by what it is made of:
///
///   sum_k left_k right_k^T + along c c^T (x) I + rest + the turning of an edge by another,
///
/// where right may be left times a core. Vectors have three numbers a point; those of five points are padded
/// to sixteen.
struct StencilTerms {
  int count = 4;                ///< of the points: four or five
  int terms = 0;                ///< of the sum: at most three
  const double* left[3] = {};   ///< [12] or [16]
  const double* right[3] = {};  ///< likewise; without a core
  const double* core =
      nullptr;                ///< [3, 3], symmetric: right_k = sum_m core_km left_m; null for none
  double along = 0.0;         ///< with four points
  const double* c = nullptr;  ///< [4]
  const double* rest = nullptr;      ///< [12, 12], with four points; null for none
  const double* turn = nullptr;      ///< [3]: its cross product between both edges; null for none
  double sign[2][kStencilPoints]{};  ///< how often a point counts in each edge
};

/// Add its blocks to a matrix on a pattern (see BlockPattern).
///
/// Only sums and products, each rounded once, in one order: the same bits at every level.
///
/// @param row    [count] of the points, each another one; negative where a point has none
/// @param start  where the columns of the pattern start
/// @param rows   of the pattern
using AddStencil = void (*)(const StencilTerms& of,
                            const std::int32_t* row,
                            const std::int32_t* start,
                            const std::int32_t* rows,
                            double* blocks);

// NOLINTEND(modernize-avoid-c-arrays)

/// @throws std::invalid_argument  where this processor or build has none of that level
AddStencil stencil_kernel(KernelLevel level);

}  // namespace diffcloth::linalg
