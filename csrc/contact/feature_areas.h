#pragma once

#include <vector>

#include "contact/collision_mesh.h"
#include "contact/sharpness.h"

namespace diffcloth::contact {

/// Area of a body that each of its corners and ridges stands for.
///
/// Rigid bodies touch at corners, and where ridges cross; what lies inside a flat face follows. So
/// the unit of area is a facet: all connected faces in one plane, however it is cut. A facet gives
/// its area
///
///   to its corners v by their angles:    A_v = sum over its facets of A alpha_v / sum alpha,
///   to its ridges e by their lengths:    A_e = sum over its facets of A l_e / perimeter,
///
/// where corners are vertices that bulge, and a ridge is all of the edges in one line between the same
/// two facets: each of its edges has the area of the whole. On a smooth surface every triangle is a
/// facet, and A_v about a third of the triangles around v.
///
/// A round body touches with a point or a line of its skin, wherever that is: as with a box, a sixth of
/// its area is of the ends of its skeleton, and a sixth of the segment between.
struct FeatureAreas {
  std::vector<double> vertex;   ///< [vertices] [m^2]; 0 where it does not bulge, and of cloths
  std::vector<double> edge;     ///< [edges] [m^2]; likewise
  std::vector<double> surface;  ///< [surfaces] of all its faces [m^2]; 0 of cloths
};

/// Area of the round body that a face stands for [m^2].
double round_area(const CollisionMesh& mesh, const double* X, std::size_t face);

/// @param X  rest positions, 3 * vertex_count
FeatureAreas feature_areas(const CollisionMesh& mesh, const double* X, const Bulge& bulge);

}  // namespace diffcloth::contact
