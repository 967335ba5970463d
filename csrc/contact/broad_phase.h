#pragma once

#include <optional>
#include <utility>
#include <vector>

#include "contact/box_tree.h"
#include "contact/collision_mesh.h"

namespace diffcloth::contact {

/// Finds the pairs of primitives that come near each other while vertices move on straight lines.
///
/// Immutable once built; the topology of its trees comes from reference positions, so that a result
/// depends on the queried motion alone. The mesh must outlive it.
class BroadPhase {
 public:
  BroadPhase(const CollisionMesh& mesh, const double* x_reference);

  /// Boxes and lists that are used again from call to call; one a thread.
  struct Scratch {
    std::vector<Box> primitives;
    std::vector<Box> boxes[6];
    std::vector<std::pair<Index, Index>> stack;
  };

  /// All pairs whose swept boxes, each inflated by radius/2 and rounded outward, overlap. Sorted.
  ///
  /// Skipped: pairs within one body, of two bodies, of elements that share a vertex, and of one
  /// cloth with itself where self contact is off.
  void find(const double* x_t0,
            const double* x_t1,
            double radius,
            Scratch& scratch,
            std::vector<Candidate>& out) const;

  /// The lowest pair (edge, face) that pierces each other, if any. Touching is not piercing.
  std::optional<std::pair<Index, Index>> find_intersection(const double* x, Scratch& scratch) const;

 private:
  /// The primitives of the cloths, then those of the bodies.
  enum Group : std::uint8_t {
    kClothVertices,
    kClothEdges,
    kClothFaces,
    kBodyVertices,
    kBodyEdges,
    kBodyFaces
  };

  template <class VertexBox>
  void refit(Group group, const VertexBox& box, Scratch& scratch) const;
  template <class VertexBox>
  void refit_all(const VertexBox& box, Scratch& scratch) const;
  template <class Visit>
  void overlaps(Group a, Group b, Scratch& scratch, const Visit& visit) const;

  /// First vertex, edge or face of a group.
  Index first(Group group) const;
  Index count(Group group) const;

  const CollisionMesh& mesh_;
  BoxTree trees_[6];
};

/// Smallest distance between two elements of one cloth that share no vertex; infinite where there
/// are none. Bodies do not count.
double smallest_nonadjacent_distance(const CollisionMesh& mesh, const double* x);

}  // namespace diffcloth::contact
