#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

// Plain arrays: those of the standard library are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Boxes that are compared outright with those of another group.
inline constexpr int kBoxGroup = 4;

/// Axis-aligned boxes side by side; what holds none is the empty box, from +infinity to -infinity.
struct BoxGroup {
  alignas(32) double lo[3][kBoxGroup];
  alignas(32) double hi[3][kBoxGroup];
};

// NOLINTEND(modernize-avoid-c-arrays)

/// Which boxes p and q of two groups are near each other: bit kBoxGroup p + q. Near are boxes, each with
/// a margin of its own around it, that are within the sum of the margins, `range`, as the crow flies
/// without them; those that overlap only where their margins have corners are not, NaN is. The outcome
/// of each comparison is as good as random, so that there are no branches.
using NearBoxes = std::uint32_t (*)(const BoxGroup& a, const BoxGroup& b, double range);

/// The same on every level.
///
/// @throws std::invalid_argument  where this processor or build has none of that level
NearBoxes near_boxes(linalg::KernelLevel level);

}  // namespace diffcloth::contact
