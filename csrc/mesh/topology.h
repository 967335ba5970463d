#pragma once

#include <array>
#include <vector>

#include "common/types.h"

namespace diffcloth::mesh {

/// Vertices, edges and faces of all cloths together, in one index space.
struct Topology {
  Index vertex_count = 0;
  std::vector<std::array<Index, 3>> faces;
  std::vector<std::array<Index, 2>> edges;       ///< unique, v0 < v1, lexicographic
  std::vector<std::array<Index, 2>> edge_faces;  ///< smaller face first, -1 if missing
  std::vector<std::array<Index, 3>> face_edges;  ///< the edge opposite corner p

  Topology() = default;

  /// @throws std::invalid_argument on an index out of range, a repeated corner, or an edge with
  ///         more than two faces.
  Topology(Index vertex_count, std::vector<std::array<Index, 3>> faces);
};

}  // namespace diffcloth::mesh
