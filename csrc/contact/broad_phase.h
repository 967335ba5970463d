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

/// Which pairs can come close at all, by swept boxes.
///
/// Immutable after construction, and safe to share between threads that each have a Scratch. Pairs
/// are: vertex and face, edge and edge, of surfaces that may touch. Pairs that share a vertex are
/// left out, as are vertices that belong to no face, and the faces of round bodies where vertices of
/// meshes meet them: the skeleton's own vertices and edge meet all faces and edges of the mesh.
class BroadPhase {
 public:
  /// @param mesh         outlives this
  /// @param x_reference  positions that shape the search trees, 3 * vertex_count
  BroadPhase(const CollisionMesh& mesh, const double* x_reference);

  const CollisionMesh& mesh() const { return mesh_; }

  struct SurfaceTrees {
    BoxTree vertices;
    BoxTree edges;
    BoxTree faces;
  };

  const SurfaceTrees& trees(Index surface) const { return trees_[surface]; }

  /// Whether vertices of one surface meet the faces of another.
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
      Vec3 motion;  ///< Mean motion of its vertices; zero where it is not worth a frame.
      Vec3 frame;   ///< Motion of the frame that the trees' boxes are in.
      bool fitted;  ///< Whether the trees' boxes belong to the present search.
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

  /// All pairs whose boxes, each swept from x_t0 to x_t1 and rounded outward, are within the sum of
  /// the two surfaces' reaches of each other. Boxes are swept in a frame that moves as a surface does on
  /// average: the second of a pair if it is a body, else the first. A cloth that flies as a whole
  /// thus meets itself as if it were at rest.
  ///
  /// Sorted; every pair that comes within the sum of the two reaches at any time of the straight
  /// motion is among them.
  ///
  /// @param reach  [surfaces] [m]
  void find(const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            Scratch& scratch,
            std::vector<Candidate>& out) const;

  /// Of the pairs that find() finds where nothing moves, those within the sum of the two surfaces' reaches
  /// of each other, and few more: many are near by their boxes alone.
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
  /// What a search is about.
  struct Sweep {
    const double* x_t0;
    const double* x_t1;
    std::span<const double> reach;
    bool of_vertices = true;  ///< whether pairs of a vertex are looked for
  };

  void measure_motion(const Sweep& sweep, Scratch& scratch) const;
  void fit(const Sweep& sweep, Index surface, const Vec3& frame, Scratch& scratch) const;
  void collect_pairs(const Sweep& sweep, Scratch& scratch) const;
  void drop_distant(const double* x, std::span<const double> reach, Scratch& scratch) const;
  void write_pairs(Scratch& scratch, std::vector<Candidate>& out) const;

  /// Visit the pairs of surfaces that may touch and whose boxes overlap, the lower first (a surface
  /// with itself included); their trees are fitted by then.
  template <class Visit>
  void visit_surface_pairs(const Sweep& sweep, Scratch& scratch, Visit&& visit) const;

  const CollisionMesh& mesh_;
  std::vector<SurfaceTrees> trees_;
};

}  // namespace diffcloth::contact
