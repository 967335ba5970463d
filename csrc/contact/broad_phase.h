#pragma once

#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "common/types.h"
#include "contact/box_tree.h"
#include "contact/collision_mesh.h"
#include "contact/pair.h"

namespace diffcloth::contact {

/// A pair that may come into contact. a: vertex or edge, b: face or edge of the collision mesh.
struct Candidate {
  PairKind kind;
  std::array<Index, 4> vertices;
  Index a;
  Index b;

  friend bool operator==(const Candidate& p, const Candidate& q) {
    return p.kind == q.kind && p.a == q.a && p.b == q.b;
  }
  friend std::strong_ordering operator<=>(const Candidate& p, const Candidate& q) {
    if (const auto order = p.kind <=> q.kind; order != 0) return order;
    if (const auto order = p.a <=> q.a; order != 0) return order;
    return p.b <=> q.b;
  }
};

inline bool share_vertex(const CollisionMesh::Edge& e, const CollisionMesh::Edge& f) {
  return (e[0] == f[0]) | (e[0] == f[1]) | (e[1] == f[0]) | (e[1] == f[1]);
}

inline bool has_vertex(const CollisionMesh::Face& face, Index v) {
  return (face[0] == v) | (face[1] == v) | (face[2] == v);
}

/// Vertex v and face f.
inline Candidate candidate_of_vertex(const CollisionMesh& mesh, Index v, Index f) {
  const auto& [i, j, k] = mesh.faces[f];
  return {.kind = PairKind::kPointTriangle, .vertices = {v, i, j, k}, .a = v, .b = f};
}

/// The edges e < f.
inline Candidate candidate_of_edges(const CollisionMesh& mesh, Index e, Index f) {
  const auto& [i, j] = mesh.edges[e];
  const auto& [k, l] = mesh.edges[f];
  return {.kind = PairKind::kEdgeEdge, .vertices = {i, j, k, l}, .a = e, .b = f};
}

/// Broad phase: finds the pairs that can come close at all, by swept boxes.
///
/// Immutable after construction, and safe to share between threads that each have a Scratch. Pairs are
/// vertex-face and edge-edge pairs of surfaces that may touch. Excluded are pairs that share a vertex,
/// vertices that belong to no face, and pairs of a mesh vertex and the face of a round body: there the
/// vertices and the edge of the skeleton are paired with all faces and edges of the mesh.
class BroadPhase {
 public:
  /// @param mesh         must outlive this object
  /// @param x_reference  positions that shape the search trees, 3 * vertex_count
  BroadPhase(const CollisionMesh& mesh, const double* x_reference);

  const CollisionMesh& mesh() const { return mesh_; }

  struct SurfaceTrees {
    BoxTree vertices;
    BoxTree edges;
    BoxTree faces;
  };

  const SurfaceTrees& trees(Index surface) const { return trees_[surface]; }

  /// True if vertices of one surface are paired with faces of another.
  bool meet(Index of_vertices, Index of_faces) const {
    return mesh_.is_round(of_vertices) || !mesh_.is_round(of_faces);
  }

  /// Boxes and lists that a search fills; reuse one to search without allocation.
  struct Scratch {
    struct Surface {
      BoxTree::Boxes vertices;
      BoxTree::Boxes edges;
      BoxTree::Boxes faces;
      Box box_t0;   ///< Around the whole surface at the start, without margin.
      Box box_t1;   ///< Likewise at the end.
      Vec3 motion;  ///< Mean motion of its vertices; zero if too small to merit its own frame.
      Vec3 frame;   ///< Motion of the frame that the trees' boxes are in.
      bool fitted;  ///< True if the trees' boxes belong to the current search.
    };
    /// Growing list that is written through a pointer.
    class PairList {
     public:
      void clear() { size_ = 0; }
      std::size_t size() const { return size_; }
      std::array<Index, 2>* begin() { return pairs_.data(); }
      std::array<Index, 2>* end() { return pairs_.data() + size_; }

      /// Pointer behind the last pair, with room for `count` more.
      std::array<Index, 2>* room(std::size_t count) {
        if (size_ + count > pairs_.size()) pairs_.resize(2 * (size_ + count));
        return end();
      }
      void push(const std::array<Index, 2>& pair) {
        *room(1) = pair;
        ++size_;
      }
      std::array<Index, 2> pop() { return pairs_[--size_]; }
      void end_at(const std::array<Index, 2>* end) { size_ = end - pairs_.data(); }

     private:
      std::vector<std::array<Index, 2>> pairs_;
      std::size_t size_ = 0;
    };
    std::vector<Box> vertex_boxes;
    std::vector<Surface> surfaces;
    PairList vertex_face_pairs;
    PairList edge_pairs;
    std::vector<std::array<Index, 2>> sorted;
    std::vector<Index> bucket;
    PairList stack;
  };

  /// All pairs whose boxes, each swept from x_t0 to x_t1 and rounded outward, are within the sum of the
  /// two surfaces' reaches of each other. Boxes are swept in a frame that moves with the mean motion of
  /// a surface: the second of a pair if it is a body, else the first. A flying cloth is therefore
  /// searched against itself as if it were at rest.
  ///
  /// Sorted. Includes every pair that comes within the sum of the two reaches at any time of the
  /// straight motion.
  ///
  /// @param reach  [surfaces] [m]
  void find(const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            Scratch& scratch,
            std::vector<Candidate>& out) const;

  /// Pairs within the sum of the two surfaces' reaches at x, and a few more: the result of find()
  /// without motion, minus most pairs that are near by their boxes alone.
  void find_at_rest(const double* x,
                    std::span<const double> reach,
                    Scratch& scratch,
                    std::vector<Candidate>& out) const;

  /// The lowest (edge, face) that intersect at x, among the pairs of surfaces that may touch.
  ///
  /// An edge that pierces a face is always found (exact arithmetic decides close calls); an edge
  /// that merely touches a face may be reported.
  std::optional<std::pair<Index, Index>> find_intersection(const double* x, Scratch& scratch) const;

 private:
  /// Input of one search.
  struct Sweep {
    const double* x_t0;
    const double* x_t1;
    std::span<const double> reach;
    bool of_vertices = true;  ///< if true, pairs of a vertex and a face are searched, too
  };

  void measure_motion(const Sweep& sweep, Scratch& scratch) const;
  void fit(const Sweep& sweep, Index surface, const Vec3& frame, Scratch& scratch) const;
  void collect_pairs(const Sweep& sweep, Scratch& scratch) const;
  void drop_distant(const double* x, std::span<const double> reach, Scratch& scratch) const;
  void write_pairs(Scratch& scratch, std::vector<Candidate>& out) const;

  /// Visit the pairs of surfaces that may touch and whose boxes overlap, the lower index first
  /// (including each surface with itself). The trees of both surfaces are fitted before the visit.
  template <class Visit>
  void visit_surface_pairs(const Sweep& sweep, Scratch& scratch, Visit&& visit) const;

  const CollisionMesh& mesh_;
  std::vector<SurfaceTrees> trees_;
};

}  // namespace diffcloth::contact
