#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "common/types.h"

namespace diffcloth::step {

/// Every continuous input of a step. All but dt are differentiable.
enum class Input : std::uint8_t {
  kPositions,          ///< x_n [N, 3] m
  kVelocities,         ///< v_n [N, 3] m/s
  kBodyPoses,          ///< frames of the roots of all trees at the start of the step [T, 7]
  kBodyTargets,        ///< at its end [T, 7]
  kPinTargets,         ///< [P, 3] m
  kSoftPinTargets,     ///< [Q, 3] m
  kForces,             ///< [N, 3] N
  kGravity,            ///< [3] m/s^2
  kStretch,            ///< k_s, one value, one a cloth or one a face [N/m]
  kBending,            ///< D, likewise [N m]
  kPoisson,            ///< nu, likewise [-]
  kDensity,            ///< rho, likewise [kg/m^2]
  kDamping,            ///< k_d, likewise [s]
  kFriction,           ///< mu, one value or [S, S] [-]
  kThickness,          ///< [S] m
  kBarrierStiffness,   ///< kappa, one value or [S, S] [Pa]
  kBarrierDistance,    ///< d_hat [m]
  kSlipVelocity,       ///< eps_v [m/s]
  kPinStiffness,       ///< k_a, one value or one a cloth [N/m]
  kRestPositions,      ///< X [N, 3] m
  kCoordinates,        ///< of mechanisms, at the start of the step [n]
  kCoordinateEnds,     ///< at its end, where prescribed [n]
  kCoordinateTargets,  ///< t [n], see bodies::CoordinatePotential
  kCoordinateMetric,   ///< A [sum n_t^2]
  kCoordinateOrigins,  ///< where friction counts their motion from [n]; absent: at the start
};
inline constexpr std::size_t kInputCount = 25;
// clang-format off
inline constexpr std::array<const char*, kInputCount> kInputNames{
    "positions", "velocities", "body_poses", "body_targets",
    "pin_targets", "soft_pin_targets", "forces", "gravity",
    "stretch", "bending", "poisson", "density",
    "damping", "friction", "thickness", "barrier_stiffness",
    "barrier_distance", "slip_velocity", "pin_stiffness", "rest_positions",
    "coordinates", "coordinate_ends", "coordinate_targets", "coordinate_metric",
    "coordinate_origins",
};
// clang-format on

/// One environment's input: a flat array, absent where data is null.
struct View {
  const double* data = nullptr;
  std::size_t count = 0;
};

struct Inputs {
  std::array<View, kInputCount> views;
  const View& operator[](Input input) const { return views[static_cast<std::size_t>(input)]; }
  const double* data(Input input) const { return (*this)[input].data; }
};

/// Where one environment's gradients go: arrays like the inputs, zeroed; null where not wanted.
struct Gradients {
  std::array<double*, kInputCount> data{};
  double* operator[](Input input) const { return data[static_cast<std::size_t>(input)]; }
};

}  // namespace diffcloth::step
