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
///
/// A body may be round: all points within its radius of a skeleton, which is a point (a sphere) or a
/// segment (a capsule). Contact with it is contact with the skeleton, at a distance that is larger by
/// the radius. Its only face, {p, p, p} or {p, q, q}, has no area: it represents the skeleton in pairs
/// with other surfaces. The skeleton uses the first vertex of the body, or the first two; the remaining
/// vertices define its orientation.
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
  std::vector<std::array<Index, 2>> edge_faces;  ///< -1 if missing; the first two of several.
  std::vector<std::array<Index, 3>> face_edges;  ///< Edge k joins the corners k and k + 1.
  std::vector<double> radius;                    ///< [surfaces] 0 if not round [m]
  SurfacePairs touching;

  CollisionMesh() = default;

  /// @param faces           corners of every face, grouped by surface in ascending order
  /// @param vertex_surface  surface of every vertex, ascending
  /// @param touching        pairs of surfaces that may touch; defines the number of surfaces
  /// @param radius          of each surface; empty: none is round
  /// @throws std::invalid_argument  if a face or vertex violates these conditions; names the first
  CollisionMesh(std::vector<Face> faces,
                std::vector<Index> vertex_surface,
                Index cloth_count,
                SurfacePairs touching,
                std::vector<double> radius = {});

  Index surface_count() const { return touching.surface_count(); }
  bool is_round(Index surface) const { return radius[surface] > 0.0; }
  /// True if a round surface is a sphere.
  bool is_point(Index surface) const { return is_point_[surface] != 0; }
  bool is_round_vertex(Index v) const { return is_round(vertex_surface[v]); }
  bool is_round_edge(Index e) const { return is_round(edge_surface[e]); }
  bool is_round_face(Index f) const { return is_round(face_surface[f]); }

 private:
  std::vector<char> is_point_;  // [surfaces]
};

}  // namespace diffcloth::contact
