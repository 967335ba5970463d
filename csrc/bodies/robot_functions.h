#pragma once

#include <memory>
#include <vector>

#include "bodies/smooth_function.h"
#include "bodies/tree.h"

namespace diffcloth::bodies {

/// What moves a joint.
enum class Actuation : std::uint8_t { kPosition, kVelocity, kTorque, kDrive };

/// What moves the root link.
enum class Base : std::uint8_t { kFixed, kKinematic, kFloating };

/// A robot in a scene, and the time step.
struct RobotModel {
  Tree tree;
  Base base = Base::kFixed;
  std::vector<Actuation> actuation;  ///< [J]
  std::vector<Index> vertex_link;    ///< [V] of the vertices that may be in contact
  std::vector<double> points;        ///< [V, 3] these, in the frames of their links
  double dt = 0.0;
  double largest = 0.0;        ///< a limit that is none
  bool is_at_rest = false;     ///< steps that look for an equilibrium
  bool bounds_weight = false;  ///< in these: the stiffness of the weight is a bound

  Index coordinate_count() const {
    return tree.joint_count + (base == Base::kFloating ? kRoot : 0);
  }
};

/// A robot over one step by itself, and its state after the step is solved: for their equations see
/// diffcloth_torch/dynamics/robots.py, which names all arrays.
std::unique_ptr<SmoothFunction> robot_prediction(const RobotModel& model);
std::unique_ptr<SmoothFunction> robot_advance(const RobotModel& model);

}  // namespace diffcloth::bodies
