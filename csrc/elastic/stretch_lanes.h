#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::elastic {

// Plain arrays: standard library arrays are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Number of triangles that are processed side by side.
inline constexpr int kStretchLanes = 8;

/// Up to eight triangles: unused lanes repeat the last one. The corners of each are in ascending order,
/// so that all its blocks are in a lower triangle.
struct FaceBatch {
  std::int32_t size;                      ///< number of used lanes
  std::int32_t vertex[3][kStretchLanes];  ///< ascending
  std::int32_t slot[6][kStretchLanes];    ///< pairs (0,0), (1,0), (1,1), (2,0), (2,1), (2,2)
  double g[4][kStretchLanes];             ///< shape gradients of corners 1 and 2 [1/m]
};

/// Isotropic triangles: see stretch.h.
struct StretchBatch {
  FaceBatch faces;
  double weight[kStretchLanes];  ///< k_s A [N m]
};

/// Woven triangles: see orthotropic_stretch.h.
struct WovenBatch {
  FaceBatch faces;                     ///< faces with shape gradients in material axes
  double stiffness[3][kStretchLanes];  ///< k_w, k_wf and k_f, times A [N m]
};

/// Damped triangles; those that are not woven have three equal stiffnesses: see orthotropic_damping.h.
struct DampingBatch {
  WovenBatch woven;  ///< weaves with stiffnesses times k_d / h
  double start[6]
              [kStretchLanes];  ///< F at the start of the step in the same axes, column by column
  double gained[3][kStretchLanes];  ///< kAhead (C_a - C_n) of damping.h likewise: uu, uv, vv; or 0
};

/// Triangles that a displacement d strains while a step turns them: see chord_strain.h.
struct ChordBatch {
  FaceBatch faces;
  double weight[kStretchLanes];     ///< k A [N m]
  double shift[6][kStretchLanes];   ///< F(d), column by column
  double center[6][kStretchLanes];  ///< F(c), likewise
};

/// q_0 of chord_strain.h, a squared strain: larger than in smooth motion at common time steps, smaller
/// than a visible strain.
inline constexpr double kFreeStrainSq = 1e-4;

// NOLINTEND(modernize-avoid-c-arrays)

/// The stretch of many triangles and its damping in lanes.
///
/// Arithmetic consists of sums, products, quotients and roots, each rounded once, in one order: all
/// levels have the same bits.
struct StretchKernels {
  /// E(x1) - E(x0), summed in the order of the triangles. With both frames orthonormal,
  ///
  ///   dE = k_s A / 2 ( <F0 - R0 + F1 - R1, dF> - 1/2 <S1 - S0, dR^T dR> ),
  ///
  /// with dF from differences of positions.
  ///
  /// @param g1  += grad E(x1), with the bits of add_gradient(); null for none
  double (*energy_change)(const StretchBatch* batches,
                          std::size_t count,
                          const double* x0,
                          const double* x1,
                          double* g1);

  /// g += grad E.
  void (*add_gradient)(const StretchBatch* batches, std::size_t count, const double* x, double* g);

  /// blocks += the Hessian,
  ///
  ///   H_pq = k_s A [ (g_p.g_q) I - (1/t) e_p e_q^T - (g_p^T S^-1 g_q) n n^T ],
  ///   e_p = g_p0 r2 - g_p1 r1,
  ///
  /// or its projection, which clamps 1/t to 1/2 and the eigenvalues of S^-1 to 1.
  ///
  /// @param place  index of each slot in blocks
  void (*add_hessian)(const StretchBatch* batches,
                      std::size_t count,
                      const double* x,
                      bool positive,
                      const std::int32_t* place,
                      double* blocks);

  // Likewise for woven triangles. The energy changes by
  //
  //   dE = k_w (a0 + a1 - 2) / 2 da + k_f (b0 + b1 - 2) / 2 db + k_wf (da + db - dt),   a = |w|, b = |f|,
  //
  // where the changes of |w|, |f| and t are computed from the changes of their squares.

  double (*woven_energy_change)(const WovenBatch* batches,
                                std::size_t count,
                                const double* x0,
                                const double* x1);

  void (*add_woven_gradient)(const WovenBatch* batches,
                             std::size_t count,
                             const double* x,
                             double* g);

  /// In the frame of R, the Hessian is the second stress out of plane, and in plane a diagonal along and
  /// across the yarns minus a rank-one term. The projected Hessian is exact if no yarn is so short that
  /// its force alone turns it, and therefore wherever the Hessian is positive; elsewhere it is no
  /// smaller than the Hessian.
  void (*add_woven_hessian)(const WovenBatch* batches,
                            std::size_t count,
                            const double* x,
                            bool positive,
                            const std::int32_t* place,
                            double* blocks);

  // Likewise for damping,
  //
  //   H_pq = 1/2 [ (g_p^T W g_q) I + F M_pq F^T ],   M_pq a = K o (a g_q^T + g_q a^T) g_p,   W = K o (C - C_n).

  double (*damping_energy_change)(const DampingBatch* batches,
                                  std::size_t count,
                                  const double* x0,
                                  const double* x1,
                                  double* g1);

  void (*add_damping_gradient)(const DampingBatch* batches,
                               std::size_t count,
                               const double* x,
                               double* g);

  /// The projected Hessian keeps the positive part of W.
  void (*add_damping_hessian)(const DampingBatch* batches,
                              std::size_t count,
                              const double* x,
                              bool positive,
                              const std::int32_t* place,
                              double* blocks);

  // Likewise for the resistance to chords, with q = |e|^2:
  //
  //   phi(q') - phi(q) = 1/2 (q' - q) (q q' + q_0 (q + q')) / ((q + q_0) (q' + q_0)),
  //   H_pq = k A [ phi' ((g_p.g_q) D D^T + D g_q (D g_p)^T) + 4 phi'' D e g_p (D e g_q)^T ],   D = F(d).

  double (*chord_energy)(const ChordBatch* batches, std::size_t count, const double* x);

  double (*chord_energy_change)(const ChordBatch* batches,
                                std::size_t count,
                                const double* x0,
                                const double* x1);

  void (*add_chord_gradient)(const ChordBatch* batches,
                             std::size_t count,
                             const double* x,
                             double* g);

  void (*add_chord_hessian)(const ChordBatch* batches,
                            std::size_t count,
                            const double* x,
                            const std::int32_t* place,
                            double* blocks);
};

/// @throws std::invalid_argument  if this processor or build has no kernels of that level
const StretchKernels& stretch_kernels(linalg::KernelLevel level);

/// The kernels of linalg::chosen_level().
const StretchKernels& stretch_kernels();

}  // namespace diffcloth::elastic
