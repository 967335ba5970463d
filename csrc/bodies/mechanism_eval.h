#pragma once

#include <vector>

#include "bodies/exponential.h"
#include "bodies/mechanisms.h"

namespace diffcloth::bodies {

/// A point under a rigid (or linear) transform.
inline Vec3 apply(const Mat34& t, const Vec3& v) { return t.leftCols<3>() * v + t.col(3); }

/// A tree at a configuration. Derivatives by joints are in the root's frame.
struct Mechanisms::Eval {
  Exponential turn{Vec3::Zero()};  // of a free root
  Vec3 center = Vec3::Zero();
  Mat34 frame;                               // S
  std::vector<Placed<double>> links;         // in the root's frame
  std::vector<Mat34> to_root;                // C_l, as matrices
  std::vector<std::vector<Mat34>> by_joint;  // [link][k]: dC_l by the k-th joint of its path
};

}  // namespace diffcloth::bodies
