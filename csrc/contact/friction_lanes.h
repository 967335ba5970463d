#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

// Plain arrays: standard library arrays are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Number of entries of a FrictionSet that are processed side by side, and of points of an entry at most.
inline constexpr int kFrictionLanes = 8;
inline constexpr int kFrictionPoints = 7;

/// Up to eight entries of a FrictionSet whose gap rotates with a single frame: see friction_set.h. Unused
/// lanes repeat the last entry.
struct FrictionBatch {
  std::int32_t size;    ///< number of used lanes
  std::int32_t points;  ///< points of the entry that has most
  std::int32_t entry[kFrictionLanes];
  std::int32_t point[kFrictionPoints][kFrictionLanes];  ///< among the points of the set
  std::int32_t edge[4][kFrictionLanes];  ///< start and end of e1, then of e2, among the same points
  double c[kFrictionPoints][kFrictionLanes];  ///< zero for points that an entry lacks
  double a[3][kFrictionLanes];                ///< zero where the frame does not turn
  double e1_start[3][kFrictionLanes];         ///< e1 at the start of the step
  double n[3][kFrictionLanes];
  double s_start[3][kFrictionLanes];
  double w_start[3][kFrictionLanes];
};

// NOLINTEND(modernize-avoid-c-arrays)

/// Layout of FrictionSet::Slip, in doubles.
struct SlipLayout {
  static constexpr std::ptrdiff_t kSize = 29;
  static constexpr std::ptrdiff_t kFrame = 0;  ///< e1, e2 and m of the first frame
  static constexpr std::ptrdiff_t kS = 18;
  static constexpr std::ptrdiff_t kW = 21;
  static constexpr std::ptrdiff_t kLaw = 24;  ///< FrictionLaw
};

/// Slips of many entries in lanes. Only sums, products, quotients and roots in the order of
/// friction_set.cpp, each rounded once: an entry has the same bits as alone, at every level.
struct FrictionKernels {
  /// @param x      positions of the set's points, 3 doubles each
  /// @param delta  their displacements since the start of the step
  /// @param e      slip at which sliding begins, see FrictionLaw
  /// @param slips  of all entries, by SlipLayout
  void (*find_slips)(const FrictionBatch* batches,
                     std::size_t count,
                     const double* x,
                     const double* delta,
                     double e,
                     double* slips);

  /// Tangential changes of the slips with a small motion of the points.
  ///
  /// @param z        motion of the set's points
  /// @param slips    of all entries, by SlipLayout
  /// @param changes  of all entries, 3 doubles each
  void (*find_changes)(const FrictionBatch* batches,
                       std::size_t count,
                       const double* z,
                       const double* slips,
                       double* changes);
};

/// @throws std::invalid_argument  if this processor or build has no kernels of that level
const FrictionKernels& friction_kernels(linalg::KernelLevel level);

}  // namespace diffcloth::contact
