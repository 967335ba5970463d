#include "projective/primitives.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace diffcloth::projective {
namespace {

/// Distance to a set of points, minus a radius, where y - w is the nearest point of the set to y.
/// `moves` is the derivative of w by y.
Nearest around(const Vec3& w, const Mat3& moves, double radius, const Vec3& fallback) {
  const double length = w.norm();
  if (!(length > 0.0)) {
    return {.distance = -radius, .normal = fallback, .normal_derivative = Mat3::Zero()};
  }
  const Vec3 n = w / length;
  return {.distance = length - radius,
          .normal = n,
          .normal_derivative = (moves - n * n.transpose()) / length};
}

Nearest nearest_of_capsule(double radius, double half_length, const Vec3& y) {
  const double z = std::clamp(y.z(), -half_length, half_length);
  Mat3 moves = Mat3::Identity();
  if (z == y.z()) moves(2, 2) = 0.0;
  return around(y - Vec3(0.0, 0.0, z), moves, radius, Vec3::UnitX());
}

Nearest nearest_of_box(const Vec3& half, const Vec3& y) {
  const Vec3 w = y - y.cwiseMax(-half).cwiseMin(half);
  if (w != Vec3::Zero()) {
    const Mat3 moves = (w.array() != 0.0).cast<double>().matrix().asDiagonal();
    return around(w, moves, 0.0, Vec3::UnitZ());
  }
  Index axis = 0;
  const double distance = (y.cwiseAbs() - half).maxCoeff(&axis);
  return {.distance = distance,
          .normal = std::copysign(1.0, y[axis]) * Vec3::Unit(axis),
          .normal_derivative = Mat3::Zero()};
}

}  // namespace

PrimitiveKind primitive_kind(std::string_view name) {
  if (name == "none") return PrimitiveKind::kNone;
  if (name == "plane") return PrimitiveKind::kPlane;
  if (name == "sphere") return PrimitiveKind::kSphere;
  if (name == "capsule") return PrimitiveKind::kCapsule;
  if (name == "box") return PrimitiveKind::kBox;
  throw std::invalid_argument(
      "a primitive must be one of 'none', 'plane', 'sphere', 'capsule', 'box', got '" +
      std::string(name) + "'");
}

Nearest nearest(const Primitive& primitive, const Vec3& y) {
  switch (primitive.kind) {
    case PrimitiveKind::kPlane:
      return {.distance = y.z(), .normal = Vec3::UnitZ(), .normal_derivative = Mat3::Zero()};
    case PrimitiveKind::kSphere:
      return around(y, Mat3::Identity(), primitive.size[0], Vec3::UnitZ());
    case PrimitiveKind::kCapsule:
      return nearest_of_capsule(primitive.size[0], primitive.size[1], y);
    case PrimitiveKind::kBox:
      return nearest_of_box(primitive.size, y);
    case PrimitiveKind::kNone:
      break;
  }
  throw std::invalid_argument("nearest: the body has no primitive");
}

}  // namespace diffcloth::projective
