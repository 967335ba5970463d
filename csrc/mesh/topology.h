#pragma once

#include <array>
#include <vector>

#include "common/types.h"

namespace diffcloth::mesh {

/// Rest vertices of an edge in its first and in its last face; both pairs differ at a seam.
struct RestEdge {
  std::array<Index, 2> first, last;

  bool is_seam() const { return first != last; }
};

/// Vertices, edges and faces of all cloths together, in one index space, and the same faces in the rest mesh.
///
/// The rest mesh may be cut at seams: a vertex of a seam then has several rest vertices, one for each piece
/// around it. Every face has a triangle of its own there, and every rest vertex belongs to one vertex.
struct Topology {
  Index vertex_count = 0;
  std::vector<std::array<Index, 3>> faces;
  std::vector<std::array<Index, 2>> edges;       ///< unique, v0 < v1, lexicographic
  std::vector<std::array<Index, 2>> edge_faces;  ///< smaller face first, -1 if missing
  std::vector<std::array<Index, 3>> face_edges;  ///< the edge opposite corner p
  Index rest_vertex_count = 0;
  std::vector<std::array<Index, 3>> rest_faces;  ///< the same corners among the rest vertices
  std::vector<RestEdge> rest_edges;              ///< the ends of `edges` among the rest vertices

  Topology() = default;

  /// @throws std::invalid_argument on an index out of range, a repeated corner, an edge with more than
  ///         two faces, or a rest vertex that belongs to several vertices.
  Topology(Index vertex_count,
           std::vector<std::array<Index, 3>> faces,
           Index rest_vertex_count,
           std::vector<std::array<Index, 3>> rest_faces);

  /// The rest mesh without seams.
  Topology(Index vertex_count, const std::vector<std::array<Index, 3>>& faces)
      : Topology(vertex_count, faces, vertex_count, faces) {}
};

}  // namespace diffcloth::mesh
