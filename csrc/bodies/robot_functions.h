#pragma once

#include <memory>
#include <vector>

#include "bodies/smooth_function.h"
#include "bodies/tree.h"

namespace diffcloth::bodies {

/// Actuation of a joint.
enum class Actuation : std::uint8_t { kPosition, kVelocity, kTorque, kDrive };

/// Motion of the root link.
enum class Base : std::uint8_t { kFixed, kKinematic, kFloating };

/// A robot in a scene, and the time step.
struct RobotModel {
  Tree tree;
  Base base = Base::kFixed;
  std::vector<Actuation> actuation;  ///< [J]
  std::vector<Index> vertex_link;    ///< [V] link of each vertex that may be in contact
  std::vector<double> points;        ///< [V, 3] these vertices, in the frames of their links
  double dt = 0.0;
  double largest = 0.0;        ///< value of a limit that means none
  bool is_at_rest = false;     ///< true if steps search for an equilibrium
  bool bounds_weight = false;  ///< with is_at_rest: use a bound of the weight's stiffness

  Index coordinate_count() const {
    return tree.joint_count + (base == Base::kFloating ? kRoot : 0);
  }
};

/// Motion of a robot over one step without contact, and its state after the solve. Equations and names
/// of all arrays: diffcloth_torch/dynamics/robots.py.
std::unique_ptr<SmoothFunction> robot_prediction(const RobotModel& model);
std::unique_ptr<SmoothFunction> robot_advance(const RobotModel& model);

}  // namespace diffcloth::bodies
