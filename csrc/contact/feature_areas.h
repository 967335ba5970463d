#pragma once

#include <vector>

#include "contact/collision_mesh.h"
#include "contact/sharpness.h"

namespace diffcloth::contact {

/// Area of a body that each of its corners and ridges represents.
///
/// Rigid bodies touch at corners, and at crossings of ridges; the inside of a flat face follows. The
/// unit of area therefore is a facet: all connected faces in one plane, regardless of their
/// triangulation. The area of a facet is distributed
///
/// A corner is a vertex that bulges; a ridge is the set of all edges in one line between the same two
/// facets, and each of its edges gets the area of the whole ridge. On a smooth surface every triangle is
/// a facet, and A_v is about a third of the triangles around v.
///
/// A round body touches with an arbitrary point or line of its surface. As for a box, a sixth of its
/// area is assigned to the ends of its skeleton, and a sixth to the segment between the ends.
struct FeatureAreas {
  std::vector<double> vertex;   ///< [vertices] [m^2]; 0 if a vertex does not bulge, and for cloths
  std::vector<double> edge;     ///< [edges] [m^2]; likewise
  std::vector<double> surface;  ///< [surfaces] total area of the faces [m^2]; 0 for cloths
};

/// Area of the round body that a face represents [m^2].
double round_area(const CollisionMesh& mesh, const double* X, std::size_t face);

/// @param X  rest positions, 3 * vertex_count
FeatureAreas feature_areas(const CollisionMesh& mesh, const double* X, const Bulge& bulge);

}  // namespace diffcloth::contact
