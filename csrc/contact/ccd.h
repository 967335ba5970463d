#pragma once

#include "contact/pair.h"

namespace diffcloth::contact {

/// Fraction in [0, 1] of the straight motion x_t0 -> x_t1 over which a pair stays farther apart
/// than xi: 1 only if the whole motion is certified, 0 if the pair is in contact at x_t0.
///
/// Additive continuous collision detection [Li et al. 2021] with a directional certificate. At the
/// time reached, with closest vector t, d = |t| and n = t/d, the motion is free over the larger of
///
///   0.9 (d - xi) / l_p    l_p: the largest relative displacement between the primitives,
///   the time for which n . (x_i - x_j) >= xi + g for every i of one and j of the other primitive,
///
/// g = 0.1 (d(0) - xi). The search ends when d - xi < g. A distance below xi + 1e-12 |x|_max counts
/// as contact, which covers the rounding of the positions.
double safe_step(PairKind kind, const Corners& x_t0, const Corners& x_t1, double xi);

}  // namespace diffcloth::contact
