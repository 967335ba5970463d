#pragma once

#include <vector>

#include "common/types.h"
#include "contact/collision_mesh.h"

namespace diffcloth::contact {

/// Rest quantities that weight contacts. Measures of cloths carry gradients; measures of bodies are
/// constant.
struct RestMeasures {
  std::vector<double> vertex_area;     ///< [vertices] a third of the adjacent faces [m^2]
  std::vector<double> edge_area;       ///< [edges] a third of the adjacent faces [m^2]
  std::vector<double> edge_length_sq;  ///< [edges] [m^2]
  std::vector<double> face_area;       ///< [faces of cloths] [m^2]
  std::vector<double> mean_face_area;  ///< [cloths] [m^2]

  /// All zero, in the sizes of a mesh.
  static RestMeasures zero(const CollisionMesh& mesh);
};

/// Measures of a mesh at rest. The area of a round body is divided between the ends of its skeleton.
///
/// @param X  rest positions, 3 * vertex_count; each surface may be in its own frame
RestMeasures measure(const CollisionMesh& mesh, const double* X);

}  // namespace diffcloth::contact
