#pragma once

#include <array>
#include <vector>

#include "common/types.h"
#include "contact/surface_pairs.h"

namespace diffcloth::contact {

/// Surfaces that may touch: the cloths' vertices first, then the bodies'.
///
/// A surface is a cloth (0 .. cloth_count - 1) or a body (from cloth_count on). Faces and edges are
/// grouped by surface in the same order.
struct CollisionMesh {
  using Face = std::array<Index, 3>;
  using Edge = std::array<Index, 2>;

  Index vertex_count = 0;
  Index cloth_vertex_count = 0;
  Index cloth_count = 0;
  std::vector<Face> faces;
  std::vector<Edge> edges;  ///< v0 < v1, each once, lexicographic within a surface.
  Index cloth_face_count = 0;
  Index cloth_edge_count = 0;
  std::vector<Index> vertex_surface;
  std::vector<Index> face_surface;
  std::vector<Index> edge_surface;
  std::vector<std::array<Index, 2>> edge_faces;  ///< -1 where missing; the first two of several.
  std::vector<std::array<Index, 3>> face_edges;  ///< Edge k joins the corners k and k + 1.
  SurfacePairs touching;

  CollisionMesh() = default;

  /// @param faces           corners of every face, grouped by surface in ascending order
  /// @param vertex_surface  surface of every vertex, ascending
  /// @param touching        which of the surfaces may touch; it says how many there are
  /// @throws std::invalid_argument naming the first face or vertex that breaks this.
  CollisionMesh(std::vector<Face> faces,
                std::vector<Index> vertex_surface,
                Index cloth_count,
                SurfacePairs touching);

  Index surface_count() const { return touching.surface_count(); }
};

}  // namespace diffcloth::contact
