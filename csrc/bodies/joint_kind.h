#pragma once

#include <span>
#include <string_view>

namespace diffcloth::bodies {

/// A kind of joint: a screw motion along the unit axis of the joint.
///
/// The value a of the joint rotates all links that it carries by the angle `turn a` about the axis and
/// shifts them by `slide a` along the axis. Frames, velocities, forces and second derivatives all follow
/// from these two numbers: see bodies/link.h.
struct JointKind {
  std::string_view name;  ///< name in Python, and type of the joint in URDF
  double turn;            ///< angle per unit of the value; 0 or 1 if the value is an angle [rad]
  double slide;           ///< shift per unit of the value [m/rad], or [-] if it is a length

  constexpr bool moves() const { return turn != 0.0 || slide != 0.0; }
};

inline constexpr JointKind kFixedJoint{.name = "fixed", .turn = 0.0, .slide = 0.0};

/// All kinds. Arrays of links store indices into this table.
std::span<const JointKind> joint_kinds();

}  // namespace diffcloth::bodies
