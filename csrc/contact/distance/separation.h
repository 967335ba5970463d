#pragma once

#include "common/types.h"
#include "contact/pair.h"

namespace diffcloth::contact {

/// Shortest vector from the second primitive of a pair to the first, for collision detection.
///
/// The shortest of several clamped candidates, each of which joins two points of the primitives;
/// none is preferred for its type, so that degenerate triangles, edges of no length and parallel
/// edges need no case of their own, and the length exceeds the distance by rounding at most.
Vec3 separation(PairKind kind, const Corners& x);

/// Squared distance |separation|^2 of a pair [m^2].
double distance_sq(PairKind kind, const Corners& x);

}  // namespace diffcloth::contact
