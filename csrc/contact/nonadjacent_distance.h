#pragma once

#include "contact/collision_mesh.h"

namespace diffcloth::contact {

/// Smallest distance between non-adjacent elements of the same cloth at x (vertex and face, edge
/// and edge) [m]; +infinity if there are none.
double smallest_nonadjacent_distance(const CollisionMesh& mesh, const double* x);

}  // namespace diffcloth::contact
