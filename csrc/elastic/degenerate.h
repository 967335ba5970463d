#pragma once

// Alone in a file: the kernels of stretch_lanes_impl.h may include no templates.

namespace diffcloth::elastic {

/// Smallest area ratio and stretch that enter a division: a degenerate triangle stays finite.
inline constexpr double kDegenerate = 1e-8;

/// Area ratio below which a frame need not be orthonormal to rounding.
inline constexpr double kNearlyDegenerate = 1e-4;

/// Length below which a vector has no direction: its square is not a normal number any more.
inline constexpr double kShortest = 1e-150;

}  // namespace diffcloth::elastic
