#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "common/types.h"

namespace diffcloth::step {

/// Every continuous input of a step. All but dt are differentiable.
enum class Input : std::uint8_t {
  kPositions,          ///< x_n [m]
  kVelocities,         ///< v_n [m/s]
  kBodyPoses,          ///< frames of the roots of all trees at the start of the step
  kBodyTargets,        ///< these frames at the end of the step
  kPinTargets,         ///< [m]
  kSoftPinTargets,     ///< [m]
  kForces,             ///< [N]
  kGravity,            ///< [m/s^2]
  kStretch,            ///< k_s [N/m]
  kBending,            ///< D [N m]
  kPoisson,            ///< nu [-]
  kDensity,            ///< rho [kg/m^2]
  kDamping,            ///< k_d [s]
  kStretchWeft,        ///< k_f [N/m]; given with k_wf, and k_s is then k_w
  kStretchShear,       ///< k_wf [N/m]
  kBendingWeft,        ///< D_f [N m]; given with D_t, and D is then D_w
  kBendingTwill,       ///< D_t [N m]
  kFriction,           ///< mu [-]
  kThickness,          ///< [m]
  kBarrierStiffness,   ///< kappa [Pa]
  kBarrierDistance,    ///< d_hat [m]
  kSlipVelocity,       ///< eps_v [m/s]
  kPinStiffness,       ///< k_a [N/m]
  kSpringTargets,      ///< [m]
  kSpringWeights,      ///< w [-]
  kSpringStiffness,    ///< k [N/m]
  kRestPositions,      ///< X [m]
  kNormalDrag,         ///< C_n [-]
  kTangentialDrag,     ///< C_t [-]
  kAirDensity,         ///< rho [kg/m^3]
  kWind,               ///< w [m/s]
  kCoordinates,        ///< coordinates of mechanisms at the start of the step
  kCoordinateEnds,     ///< coordinates at the end of the step, where prescribed
  kCoordinateTargets,  ///< t, see bodies::CoordinatePotential
  kCoordinateMetric,   ///< A
  kJointTerms,         ///< rows of bodies::JointTerm; absent: no coordinate has one
  kFrictionOrigins,    ///< where friction counts motion from [m]; absent: at the start
};

/// Extent of an input: the entities that have one value each. N vertices, M rest vertices, F faces and C
/// cloths; T trees and n coordinates of mechanisms; S surfaces.
enum class Extent : std::uint8_t {
  kOne,           ///< []
  kVector,        ///< [3]
  kVertices,      ///< [N, 3]
  kRestVertices,  ///< [M, 3]
  kAllVertices,   ///< [N + V, 3], with the vertices of bodies and links
  kPins,          ///< [P, 3]
  kSoftPins,      ///< [Q, 3]
  kAttachments,   ///< [A]
  kTargets,       ///< [U, 3], of attachments to targets
  kPerFace,       ///< one value, one a cloth or one a face
  kPerCloth,      ///< one value or one a cloth
  kTrees,         ///< [T, 7]
  kSurfaces,      ///< [S]
  kPairs,         ///< one value or [S, S]
  kCoordinates,   ///< [n]
  kJointTerms,    ///< [n, 7]
  kBlocks,        ///< [sum n_t^2], tree after tree
};

/// Condition under which a step needs an input; otherwise the input may be absent.
enum class Need : std::uint8_t {
  kExtent,           ///< where the scene has anything of its extent
  kNowhere,          ///< nowhere: the input has a default
  kCloths,           ///< where there are cloths
  kBarrier,          ///< where there is a barrier
  kSoftPins,         ///< where there are soft pins
  kFreeCoordinates,  ///< where forces move coordinates
};

struct InputRow {
  constexpr InputRow(Input input_in,
                     const char* name_in,
                     Extent extent_in,
                     Need need_in = Need::kExtent)
      : input(input_in), name(name_in), extent(extent_in), need(need_in) {}

  Input input;
  const char* name;
  Extent extent;
  Need need;
};

/// The inputs by their names, in the order of Input.
inline constexpr std::array kInputTable{
    InputRow{Input::kPositions, "positions", Extent::kVertices},
    InputRow{Input::kVelocities, "velocities", Extent::kVertices},
    InputRow{Input::kBodyPoses, "body_poses", Extent::kTrees},
    InputRow{Input::kBodyTargets, "body_targets", Extent::kTrees},
    InputRow{Input::kPinTargets, "pin_targets", Extent::kPins},
    InputRow{Input::kSoftPinTargets, "soft_pin_targets", Extent::kSoftPins},
    InputRow{Input::kForces, "forces", Extent::kVertices},
    InputRow{Input::kGravity, "gravity", Extent::kVector},
    InputRow{Input::kStretch, "stretch", Extent::kPerFace},
    InputRow{Input::kBending, "bending", Extent::kPerFace},
    InputRow{Input::kPoisson, "poisson", Extent::kPerFace, Need::kNowhere},
    InputRow{Input::kDensity, "density", Extent::kPerFace},
    InputRow{Input::kDamping, "damping", Extent::kPerFace},
    InputRow{Input::kStretchWeft, "stretch_weft", Extent::kPerFace, Need::kNowhere},
    InputRow{Input::kStretchShear, "stretch_shear", Extent::kPerFace, Need::kNowhere},
    InputRow{Input::kBendingWeft, "bending_weft", Extent::kPerFace, Need::kNowhere},
    InputRow{Input::kBendingTwill, "bending_twill", Extent::kPerFace, Need::kNowhere},
    InputRow{Input::kFriction, "friction", Extent::kPairs, Need::kBarrier},
    InputRow{Input::kThickness, "thickness", Extent::kSurfaces, Need::kBarrier},
    InputRow{Input::kBarrierStiffness, "barrier_stiffness", Extent::kPairs, Need::kNowhere},
    InputRow{Input::kBarrierDistance, "barrier_distance", Extent::kOne, Need::kBarrier},
    InputRow{Input::kSlipVelocity, "slip_velocity", Extent::kOne, Need::kBarrier},
    InputRow{Input::kPinStiffness, "pin_stiffness", Extent::kPerCloth, Need::kSoftPins},
    InputRow{Input::kSpringTargets, "attachment_targets", Extent::kTargets},
    InputRow{Input::kSpringWeights, "attachment_weights", Extent::kAttachments},
    InputRow{Input::kSpringStiffness, "attachment_stiffness", Extent::kAttachments},
    InputRow{Input::kRestPositions, "rest_positions", Extent::kRestVertices, Need::kNowhere},
    InputRow{Input::kNormalDrag, "normal_drag", Extent::kPerFace},
    InputRow{Input::kTangentialDrag, "tangential_drag", Extent::kPerFace},
    InputRow{Input::kAirDensity, "air_density", Extent::kOne, Need::kCloths},
    InputRow{Input::kWind, "wind", Extent::kVector, Need::kCloths},
    InputRow{Input::kCoordinates, "coordinates", Extent::kCoordinates},
    InputRow{Input::kCoordinateEnds, "coordinate_ends", Extent::kCoordinates},
    InputRow{Input::kCoordinateTargets, "coordinate_targets", Extent::kCoordinates,
             Need::kFreeCoordinates},
    InputRow{Input::kCoordinateMetric, "coordinate_metric", Extent::kBlocks,
             Need::kFreeCoordinates},
    InputRow{Input::kJointTerms, "joint_terms", Extent::kJointTerms, Need::kNowhere},
    InputRow{Input::kFrictionOrigins, "friction_origins", Extent::kAllVertices, Need::kNowhere},
};
inline constexpr std::size_t kInputCount = kInputTable.size();

static_assert([] {
  for (std::size_t k = 0; k < kInputCount; ++k) {
    if (static_cast<std::size_t>(kInputTable[k].input) != k) return false;
  }
  return true;
}());

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

/// Gradients of one environment: arrays like the inputs, zeroed; null where not requested.
struct Gradients {
  std::array<double*, kInputCount> data{};
  double* operator[](Input input) const { return data[static_cast<std::size_t>(input)]; }
};

/// Name and shape of an array of doubles of each environment: an output, or a part of the tape.
struct Field {
  std::string name;
  std::vector<std::size_t> shape;

  std::size_t size() const {
    std::size_t result = 1;
    for (const std::size_t extent : shape) result *= extent;
    return result;
  }
};

/// One environment's arrays by name. T is double or const double.
template <class T>
class Arrays {
 public:
  void set(std::string_view name, T* data) { entries_.emplace_back(name, data); }
  bool empty() const { return entries_.empty(); }

  T* operator[](std::string_view name) const {
    for (const auto& [own, data] : entries_) {
      if (own == name) return data;
    }
    throw std::out_of_range("step: no array '" + std::string(name) + "'");
  }

 private:
  std::vector<std::pair<std::string, T*>> entries_;
};

}  // namespace diffcloth::step
