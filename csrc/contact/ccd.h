#pragma once

#include "contact/distance/closest.h"

namespace diffcloth::contact {

/// Fraction in [0, 1] of the straight motion x_t0 -> x_t1 over which the pair certainly stays
/// farther apart than xi; 1 only when the whole motion does.
///
/// Additive continuous collision detection [Li et al. 2021, Codimensional IPC]: steps that the
/// distance certifies, or, where longer, that the separating direction n at the current point
/// certifies (n . (x_i - x_j) stays above xi for all inter-primitive pairs: true for any unit n).
/// Conservative under rounding: closer than xi + 1e-12 |x| counts as contact.
double safe_step(PairKind kind, const Corners& x_t0, const Corners& x_t1, double xi);

}  // namespace diffcloth::contact
