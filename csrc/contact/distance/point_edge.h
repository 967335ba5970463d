#pragma once

#include "contact/distance/closest.h"

namespace diffcloth::contact {

/// Consider corner p against the edge (i, j) of a pair, and keep the closest vector if it is
/// shorter than the best so far.
///
/// @param sign  +1 when p belongs to the first primitive, -1 when to the second
void consider_point_edge(const Corners& x, int p, int i, int j, double sign, Closest& best);

}  // namespace diffcloth::contact
