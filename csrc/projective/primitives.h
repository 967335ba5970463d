#pragma once

#include <cstdint>
#include <string_view>

#include "common/types.h"

namespace diffcloth::projective {

/// Analytic surfaces around the origin of a body's frame. kNone: the body has only a mesh.
enum class PrimitiveKind : std::uint8_t { kNone, kPlane, kSphere, kCapsule, kBox };

/// Kind with this name: "none", "plane", "sphere", "capsule" or "box".
///
/// @throws std::invalid_argument
PrimitiveKind primitive_kind(std::string_view name);

/// A solid with a signed distance in closed form.
struct Primitive {
  PrimitiveKind kind = PrimitiveKind::kNone;
  /// Plane z <= 0: unused. Sphere: (radius, -, -). Capsule along z: (radius, half length of the
  /// cylinder, -). Box: half lengths [m].
  Vec3 size = Vec3::Zero();
};

/// Signed distance of a point from a primitive, with its derivatives.
struct Nearest {
  double distance;         ///< negative inside [m]
  Vec3 normal;             ///< outward; the gradient of the distance
  Mat3 normal_derivative;  ///< dn/dy: symmetric, it maps n to zero [1/m]

  /// Nearest point of the surface.
  Vec3 surface_point(const Vec3& y) const { return y - distance * normal; }

  /// Derivative of the nearest point by y; symmetric.
  Mat3 surface_point_derivative() const {
    return Mat3::Identity() - normal * normal.transpose() - distance * normal_derivative;
  }
};

/// Signed distance, normal and its derivative at a point of the body's frame.
///
/// If several points of the surface are nearest (for a center, the axis of a capsule, the diagonals
/// inside a box), one of the normals is returned.
Nearest nearest(const Primitive& primitive, const Vec3& y);

}  // namespace diffcloth::projective
