#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::elastic {

// Plain arrays: standard library arrays are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Number of bending elements that are processed side by side.
inline constexpr int kBendingLanes = 8;

/// The i-th vertices of eight elements.
struct BendingPoint {
  std::int32_t vertex[kBendingLanes];
  std::int32_t slot[3][kBendingLanes];   ///< slots of its blocks with base corners up to itself
  std::int64_t above[3][kBendingLanes];  ///< -1 if transposed, else 0
  double c[3][kBendingLanes];            ///< c_uu, c_uv, c_vv [1/m^2]
};

/// Up to eight elements with equal numbers of vertices: unused lanes repeat the last element with weight
/// zero. See bending.h for the notation.
struct BendingBatch {
  std::int32_t size;              ///< number of used lanes
  std::int32_t points;            ///< vertices of an element
  std::int32_t first;             ///< index of the batch's first point
  std::int32_t curved;            ///< 0 if b is zero in all lanes
  double g[4][kBendingLanes];     ///< shape gradients of corners 1 and 2 of the base triangle [1/m]
  double Q[6][kBendingLanes];     ///< lower triangle of weight Q, row by row
  double damping[kBendingLanes];  ///< k_d / h [-]
  double b[9][kBendingLanes];     ///< column by column [1/m]
  double b_n[9][kBendingLanes];   ///< likewise; zero without damping
};

/// State of the elements of a batch at one point, which all evaluations there share.
struct BendingState {
  double R[9][kBendingLanes];      ///< rotation of the frame, column by column
  double S_inv[3][kBendingLanes];  ///< S^-1 of frame.h: 11, 12 and 22
  double t[kBendingLanes];         ///< t of frame.h
  double Y[9][kBendingLanes];      ///< sum_i x_i c_i^T, column by column
};

// NOLINTEND(modernize-avoid-c-arrays)

/// The bending of many elements that are not flat, E of bending.h, in lanes. As in StretchKernels, all
/// levels have the same bits.
struct BendingKernels {
  /// Compute the state of each batch at x.
  ///
  /// @param at  [count]
  void (*evaluate)(const BendingBatch* batches,
                   std::size_t count,
                   const BendingPoint* points,
                   const double* x,
                   BendingState* at);

  /// E(x1) - E(x0) from differences of positions, summed in the order of the elements.
  ///
  /// @param dx     x1 - x0
  /// @param start  states at x0
  /// @param end    set to the states at x1, with the bits of evaluate()
  /// @param g1     += grad E(x1), with the bits of add_gradient(); null for none
  double (*energy_change)(const BendingBatch* batches,
                          std::size_t count,
                          const BendingPoint* points,
                          const double* x1,
                          const double* dx,
                          const BendingState* start,
                          BendingState* end,
                          double* g1);

  /// g += grad E, for the states at a point.
  void (*add_gradient)(const BendingBatch* batches,
                       std::size_t count,
                       const BendingPoint* points,
                       const BendingState* at,
                       double* g);

  /// blocks += the Hessian without its multiples of the identity,  (1 + damping) c_i^T Q c_j I  with the
  /// weight in Q, or the Gauss-Newton matrix. With the derivative A_j = d omega / d x_j of the frame's
  /// rotation, zero beyond the base triangle, the Hessian has the blocks
  ///
  ///   H_ij = [m_i]x A_j - A_i^T [m_j]x + A_i^T (tr(M) I - M) A_j + D_ij,
  ///   m_i = R (b + damping b_n) Q c_i,   M = R [ (b Q + q) b^T + (damping b_n Q + q_n) b_n^T ] R^T,
  ///
  /// where q and q_n are the work conjugates of s and s_n in the body frame, and D_ij is the
  /// contribution of the change of the rotation itself, see rotation_change_adjoint() in frame.h. The
  /// Gauss-Newton matrix omits q, q_n and D_ij.
  ///
  /// @param place  index of each slot in blocks
  void (*add_hessian)(const BendingBatch* batches,
                      std::size_t count,
                      const BendingPoint* points,
                      const BendingState* at,
                      bool positive,
                      const std::int32_t* place,
                      double* blocks);
};

/// @throws std::invalid_argument  if this processor or build has no kernels of that level
const BendingKernels& bending_kernels(linalg::KernelLevel level);

}  // namespace diffcloth::elastic
