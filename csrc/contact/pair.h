#pragma once

#include <array>
#include <cstdint>

#include "common/types.h"

namespace diffcloth::contact {

/// Primitives of a contact pair.
enum class PairKind : std::uint8_t { kPointTriangle, kEdgeEdge };

/// Corners of a pair: point, t0, t1, t2; or a0, a1, b0, b1.
using Corners = std::array<Vec3, 4>;

}  // namespace diffcloth::contact
