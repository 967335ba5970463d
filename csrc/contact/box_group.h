#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

// Plain arrays: std::array is a template, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Number of boxes in a group; two groups are compared box by box, without a hierarchy.
inline constexpr int kBoxGroup = 4;

/// Axis-aligned boxes side by side. An unused slot holds the empty box, from +infinity to -infinity.
struct BoxGroup {
  alignas(32) double lo[3][kBoxGroup];
  alignas(32) double hi[3][kBoxGroup];
};

// NOLINTEND(modernize-avoid-c-arrays)

/// Pairs of nearby boxes of two groups: bit kBoxGroup p + q is set if box p of `a` and box q of `b` are
/// near.
/// Each box includes its own margin; `range` is the sum of the two margins. Two boxes are near if they
/// overlap and the Euclidean distance of the boxes without margins is at most `range`; overlap of the
/// corners of two margins does not suffice. A distance of NaN counts as near. The kernel has no
/// branches, because the outcome of each comparison is unpredictable.
using NearBoxes = std::uint32_t (*)(const BoxGroup& a, const BoxGroup& b, double range);

/// Kernel for a level. All levels return identical bits.
///
/// @throws std::invalid_argument  if this processor or build does not support the level
NearBoxes near_boxes(linalg::KernelLevel level);

}  // namespace diffcloth::contact
