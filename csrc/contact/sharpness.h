#pragma once

#include <vector>

#include "common/types.h"
#include "contact/collision_mesh.h"

namespace diffcloth::contact {

/// Convexity of the bodies of a mesh at their edges and vertices, from their rest positions X.
///
/// A part (faces connected by edges) is solid if it is closed, consistently oriented and encloses a
/// positive volume. On a solid part an edge or a vertex that is concave from outside has angle 0; other
/// parts may be touched from both sides, and count as convex everywhere.
struct Bulge {
  std::vector<double> edge;    ///< [edges] exterior dihedral angle, pi at boundaries [rad]
  std::vector<double> vertex;  ///< [vertices] solid angle of the normals [sr]
  std::vector<char> flat;      ///< [edges] true if the edge lies inside a plane
};

/// Angles below 1e-4, the rounding of meshes in single precision, count as flat, and are 0. The entries
/// of cloths and of round bodies are 0.
Bulge bulge(const CollisionMesh& mesh, const double* X);

}  // namespace diffcloth::contact
