#pragma once

#include "contact/pair.h"

namespace diffcloth::contact {

/// Fraction in [0, limit] of the straight motion x_t0 -> x_t1 over which a pair stays farther apart
/// than xi: the limit only if that much is certified, 0 if the pair is in contact at x_t0.
///
/// It is the time at which the gap d - xi first falls to g = 0.1 min(d(0) - xi, d_hat), to rounding. So it
/// does not jump where the motion changes a little, which a share of the gap at which a search happens
/// to end would do. Pairs that no barrier sees on the whole motion are never the first.
///
/// Additive continuous collision detection [Li et al. 2021] with a directional certificate. At the
/// time reached, with closest vector t, d = |t| and n = t/d, the gap is g or more over the larger of
///
///   (d - xi - g) / l_p    l_p: the largest relative displacement between the primitives,
///   the time for which n . (x_i - x_j) >= xi + g for every i of one and j of the other primitive.
///
/// A distance below xi + 1e-12 |x|_max counts as contact, which covers the rounding of the positions.
///
/// @param d_hat  barrier distance [m]
/// @param limit  beyond which nobody asks
double safe_step(PairKind kind,
                 const Corners& x_t0,
                 const Corners& x_t1,
                 double xi,
                 double d_hat,
                 double limit = 1.0);

/// A pair that stays farther apart than this on all of a motion is not the first: its safe_step() is the limit.
///
/// @param largest  of the coordinates at both ends [m]
double harmless_distance(double xi, double d_hat, double largest);

}  // namespace diffcloth::contact
