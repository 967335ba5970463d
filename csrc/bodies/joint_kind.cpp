#include "bodies/joint_kind.h"

#include <array>

namespace diffcloth::bodies {
namespace {

constexpr std::array kJointKinds{
    kFixedJoint,
    JointKind{.name = "revolute", .turn = 1.0, .slide = 0.0},
    JointKind{.name = "prismatic", .turn = 0.0, .slide = 1.0},
};

}  // namespace

std::span<const JointKind> joint_kinds() { return kJointKinds; }

}  // namespace diffcloth::bodies
