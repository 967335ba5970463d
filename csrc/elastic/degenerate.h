#pragma once

// In a separate file, as the kernels of stretch_lanes_impl.h must not include templates.

namespace diffcloth::elastic {

/// Smallest area ratio and stretch in a division: results for degenerate triangles stay finite.
inline constexpr double kDegenerate = 1e-8;

/// Area ratio below which a frame may not be orthonormal to rounding.
inline constexpr double kNearlyDegenerate = 1e-4;

/// Length below which a vector has no direction: its square would not be a normal number.
inline constexpr double kShortest = 1e-150;

}  // namespace diffcloth::elastic
