#pragma once

#include <array>

namespace diffcloth::bodies {

/// How a body by itself turns over a time: the quaternion (w, x, y, z) of Q in R Q, in its own axes.
using Turn = std::array<double, 4>;

/// Derivatives of a turn's four numbers by the nine of J, row after row, and the three of l.
using TurnRate = std::array<std::array<double, 12>, 4>;

/// Euler's equations of a free body in its own axes,
///
///   dQ/dt = Q (omega x),   dl/dt = l x omega,   omega = J^-1 l,   Q(0) = 1,
///
/// by their power series in time, to rounding. So are energy and angular momentum, and a high speed
/// only takes more series.
///
/// @param inertia   J, 9 numbers [kg m^2]
/// @param momentum  l at the start [kg m^2/s]
/// @param time      [s]
/// @param rate      its derivatives; nullptr where nobody asks
/// @returns  false where the body makes more than some thousands of turns, or has no finite speed
bool free_turn(
    const double* inertia, const double* momentum, double time, Turn& turn, TurnRate* rate);

}  // namespace diffcloth::bodies
