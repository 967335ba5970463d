#pragma once

#include "common/types.h"
#include "contact/pair.h"

namespace diffcloth::contact {

/// Shortest vector from the second primitive of a pair to the first, for collision detection.
///
/// Minimum over several clamped candidates, each of which joins two points of the primitives. No type of
/// candidate is preferred: degenerate triangles, edges of zero length and parallel edges need no special
/// case, and the length exceeds the distance by rounding at most.
Vec3 separation(PairKind kind, const Corners& x);

/// Squared distance |separation|^2 of a pair [m^2].
double distance_sq(PairKind kind, const Corners& x);

}  // namespace diffcloth::contact
