#pragma once

#include "contact/pair.h"

namespace diffcloth::contact {

/// Fraction in [0, limit] of the straight motion x_t0 -> x_t1 over which a pair stays farther apart than
/// xi: the limit only if the motion is certified up to it, 0 if the pair is in contact at x_t0.
///
/// The result is the time at which the gap d - xi first falls to g = 0.1 min(d(0) - xi, d_hat), to
/// rounding. It is therefore continuous in the motion, in contrast to the gap at which an iteration
/// happens to terminate. Pairs that stay outside the barrier's range on the whole motion never determine
/// the minimum.
///
/// Additive continuous collision detection (CCD) [Li et al. 2021] with a directional certificate. At the
/// current time, with closest vector t, d = |t| and n = t/d, the gap is at least g over the larger of
///
///   (d - xi - g) / l_p    l_p: the largest relative displacement between the primitives,
///   the time for which n . (x_i - x_j) >= xi + g for every i of one and j of the other primitive.
///
/// A distance below xi + 1e-12 |x|_max counts as contact, which covers the rounding of the positions.
///
/// @param d_hat  barrier distance [m]
/// @param limit  upper bound of the result; later times are not searched
double safe_step(PairKind kind,
                 const Corners& x_t0,
                 const Corners& x_t1,
                 double xi,
                 double d_hat,
                 double limit = 1.0);

/// Distance such that a pair that stays farther apart on all of a motion never limits it: its
/// safe_step() is the limit.
///
/// @param largest  largest absolute coordinate at both ends [m]
double harmless_distance(double xi, double d_hat, double largest);

}  // namespace diffcloth::contact
