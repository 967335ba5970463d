#pragma once

#include <array>
#include <compare>
#include <vector>

#include "common/types.h"
#include "contact/distance/closest.h"

namespace diffcloth::contact {

/// All surfaces that may touch, in one index space: the cloths' vertices, faces and edges first,
/// then the bodies'.
struct CollisionMesh {
  Index vertex_count;
  Index cloth_vertex_count;
  Index cloth_count;
  std::vector<std::array<Index, 3>> faces;
  std::vector<std::array<Index, 2>> edges;  ///< unique, v0 < v1, lexicographic
  Index cloth_face_count;
  Index cloth_edge_count;
  std::vector<Index> vertex_surface;  ///< 0..C-1 cloths, C.. bodies
  std::vector<Index> edge_surface;
  std::vector<Index> face_surface;
  std::vector<std::vector<Index>> edge_faces;  ///< any number: bodies need not be manifold
  bool self_contact;                           ///< each cloth against itself

  /// @param faces  the cloths' first
  CollisionMesh(Index vertex_count,
                Index cloth_vertex_count,
                Index cloth_count,
                std::vector<std::array<Index, 3>> faces,
                std::vector<Index> vertex_surface,
                bool self_contact);

  /// Whether two primitives of these surfaces may touch: not two bodies, and one cloth with itself
  /// only where self contact is on.
  bool may_touch(Index surface_a, Index surface_b) const {
    if (surface_a == surface_b) return surface_a < cloth_count && self_contact;
    return surface_a < cloth_count || surface_b < cloth_count;
  }
};

/// A pair that may come close: point and triangle (a: vertex, b: face) or two edges (a < b).
struct Candidate {
  PairKind kind;
  Index a, b;
  std::array<Index, 4> vertices;

  friend auto operator<=>(const Candidate& p, const Candidate& q) {
    if (const auto c = p.kind <=> q.kind; c != 0) return c;
    if (const auto c = p.a <=> q.a; c != 0) return c;
    return p.b <=> q.b;
  }
  friend bool operator==(const Candidate& p, const Candidate& q) {
    return p.kind == q.kind && p.a == q.a && p.b == q.b;
  }
};

}  // namespace diffcloth::contact
