#pragma once

#include "common/types.h"

namespace diffcloth::contact {

/// Sign of the determinant [b - a, c - a, d - a], exact for all finite doubles of usual size: +1 if a,
/// b, c appear counterclockwise from d, 0 if the four points are coplanar.
int orientation(const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d);

/// True if the edge e0 e1 pierces the triangle t0 t1 t2, or touches it from outside its plane.
bool pierces(const Vec3& e0, const Vec3& e1, const Vec3& t0, const Vec3& t1, const Vec3& t2);

}  // namespace diffcloth::contact
