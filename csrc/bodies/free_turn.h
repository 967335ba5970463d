#pragma once

#include <array>

namespace diffcloth::bodies {

/// Free rotation of a body over a time: quaternion (w, x, y, z) of Q in R Q, in its own axes.
using Turn = std::array<double, 4>;

/// Derivatives of the quaternion's four numbers by the nine of J, row by row, and the three of l.
using TurnRate = std::array<std::array<double, 12>, 4>;

/// Euler's equations of a free body in its own axes,
///
///   dQ/dt = Q (omega x),   dl/dt = l x omega,   omega = J^-1 l,   Q(0) = 1,
///
/// by their power series in time, to rounding. Energy and angular momentum are preserved likewise; a
/// high speed only requires more series.
///
/// @param inertia   J, 9 numbers [kg m^2]
/// @param momentum  l at the start [kg m^2/s]
/// @param time      [s]
/// @param rate      derivatives of `turn`; may be nullptr
/// @returns  false if the body makes more than some thousands of turns, or its speed is not finite
bool free_turn(
    const double* inertia, const double* momentum, double time, Turn& turn, TurnRate* rate);

}  // namespace diffcloth::bodies
