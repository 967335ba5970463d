#pragma once

#include <cstddef>
#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

/// Squared distances of many pairs of one kind, several at once [m^2]: those of distance_sq(), but for rounding,
/// and the same on every level, whatever pairs are beside them.
///
/// @param edges    two edges, or a point and a triangle
/// @param corners  where the four vertices of the first pair are; those of the next follow `stride` later
/// @param count    of the pairs
using SquaredDistances = void (*)(bool edges,
                                  const double* x,
                                  const std::int32_t* corners,
                                  std::ptrdiff_t stride,
                                  std::ptrdiff_t count,
                                  double* d_sq);

/// @throws std::invalid_argument  where this processor or build has none of that level
SquaredDistances squared_distances(linalg::KernelLevel level);

}  // namespace diffcloth::contact
