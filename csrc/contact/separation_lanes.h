#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

/// Squared distances of many pairs of one kind, several at once [m^2]: equal to distance_sq() up to
/// rounding, and bitwise equal on every level, regardless of adjacent pairs.
///
/// @param edges    true: two edges; false: a point and a triangle
/// @param corners  the four vertices of the first pair; the next pair follows at `stride`
/// @param count    number of pairs
using SquaredDistances = void (*)(bool edges,
                                  const double* x,
                                  const std::int32_t* corners,
                                  std::ptrdiff_t stride,
                                  std::ptrdiff_t count,
                                  double* d_sq);

/// @throws std::invalid_argument  if this processor or build does not support the level
SquaredDistances squared_distances(linalg::KernelLevel level);

}  // namespace diffcloth::contact
