#include "contact/relative_search.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "contact/distance/separation.h"

namespace diffcloth::contact {
namespace {

/// Number of pairs of leaves between two checkpoints.
constexpr std::size_t kLeavesAtOnce = 256;

void include(Box& box, const double* p) {
  for (int k = 0; k < 3; ++k) {
    box.lo[k] = std::min(box.lo[k], p[k]);
    box.hi[k] = std::max(box.hi[k], p[k]);
  }
}

/// Compute the part of every node: of a leaf from its items, of an inner node from its children.
template <class Parts, class OfLeaf, class United>
void fit_nodes(const BoxTree& tree, Parts& parts, OfLeaf&& of_leaf, United&& unite) {
  parts.resize(tree.nodes().size());
  for (std::size_t k = tree.nodes().size(); k-- > 0;) {
    const BoxTree::Node& node = tree.nodes()[k];
    if (node.left > 0) {
      unite(parts[k], parts[node.left], parts[node.left + 1]);
    } else {
      of_leaf(parts[k], tree.items_of(node));
    }
  }
}

/// Call visit(tree, parts, corners of an item) for the three trees of a surface.
template <class Surface, class Visit>
void for_each_tree(const BroadPhase& broad_phase, Index s, Surface& surface, Visit&& visit) {
  const CollisionMesh& mesh = broad_phase.mesh();
  const BroadPhase::SurfaceTrees& trees = broad_phase.trees(s);
  visit(trees.vertices, surface.vertices, [](Index v) { return std::array<Index, 1>{v}; });
  visit(trees.edges, surface.edges, [&](Index e) { return mesh.edges[e]; });
  visit(trees.faces, surface.faces, [&](Index f) { return mesh.faces[f]; });
}

/// Boxes of an item at both ends of a motion.
struct Swept {
  Box t0 = kEmptyBox;
  Box t1 = kEmptyBox;
};

/// Boxes of the items of a leaf at both ends of the motion.
template <class Corners>
std::array<Swept, kBoxGroup> sweep(std::span<const Index> items,
                                   Corners&& corners,
                                   const RelativeSearch::Wanted& wanted) {
  std::array<Swept, kBoxGroup> result;
  for (std::size_t k = 0; k < items.size(); ++k) {
    for (const Index v : corners(items[k])) {
      include(result[k].t0, wanted.x_t0 + 3 * v);
      include(result[k].t1, wanted.x_t1 + 3 * v);
    }
  }
  return result;
}

/// True unless the boxes of two items, swept in relative motion, stay farther apart than `range`.
bool may_meet(const Swept& a, const Swept& b, double range) {
  double sum = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double lo = std::min(a.t0.lo[k] - b.t0.hi[k], a.t1.lo[k] - b.t1.hi[k]);
    const double hi = std::max(a.t0.hi[k] - b.t0.lo[k], a.t1.hi[k] - b.t1.lo[k]);
    const double apart = std::max(lo, -hi);
    sum += apart > 0.0 ? apart * apart : 0.0;
  }
  return sum <= range * range;
}

/// Visit the pairs of items of two leaves that may come within range.
template <class CornersA, class CornersB, class Visit>
void visit_items(std::span<const Index> a,
                 CornersA&& corners_a,
                 std::span<const Index> b,
                 CornersB&& corners_b,
                 const RelativeSearch::Wanted& wanted,
                 double range,
                 Visit&& visit) {
  const auto swept_a = sweep(a, corners_a, wanted);
  const auto swept_b = sweep(b, corners_b, wanted);
  for (std::size_t i = 0; i < a.size(); ++i) {
    for (std::size_t j = a.data() == b.data() ? i + 1 : 0; j < b.size(); ++j) {
      if (may_meet(swept_a[i], swept_b[j], range)) visit(a[i], b[j]);
    }
  }
}

}  // namespace

double approach_sq(const Candidate& pair, const double* u_t0, const double* u_t1) {
  const int first =
      pair.kind == PairKind::kPointTriangle ? 1 : 2;  // corner of the second primitive
  double result = 0.0;
  for (const double* u : {u_t0, u_t1}) {
    const auto& v = pair.vertices;
    const Corners at{row(u, v[0]), row(u, v[1]), row(u, v[2]), row(u, v[3])};
    for (int i = 0; i < first; ++i) {
      for (int j = first; j < 4; ++j) result = std::max(result, (at[i] - at[j]).squaredNorm());
    }
  }
  return result;
}

/// True if anything in two parts may have moved by more than `least` against each other, and may come
/// within range on the motion. Branch-free, as the outcome is unpredictable.
bool RelativeSearch::may_meet(const Part& a, const Part& b, double range, double least) {
  double moved_t0 = 0.0;
  double moved_t1 = 0.0;
  double apart_sq = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double lo_t0 = a.u_t0.lo[k] - b.u_t0.hi[k];
    const double hi_t0 = a.u_t0.hi[k] - b.u_t0.lo[k];
    const double lo_t1 = a.u_t1.lo[k] - b.u_t1.hi[k];
    const double hi_t1 = a.u_t1.hi[k] - b.u_t1.lo[k];
    const double most_t0 = std::max(hi_t0, -lo_t0);
    const double most_t1 = std::max(hi_t1, -lo_t1);
    moved_t0 += most_t0 * most_t0;
    moved_t1 += most_t1 * most_t1;
    const double lo = a.place.lo[k] - b.place.hi[k] + std::min(lo_t0, lo_t1);
    const double hi = a.place.hi[k] - b.place.lo[k] + std::max(hi_t0, hi_t1);
    const double apart = std::max(lo, -hi);
    apart_sq += apart > 0.0 ? apart * apart : 0.0;
  }
  const double least_sq = least * least;
  return ((moved_t0 > least_sq) | (moved_t1 > least_sq)) & (apart_sq <= range * range);
}

void RelativeSearch::start(const double* reference) {
  surfaces_.resize(broad_phase_->mesh().surface_count());
  for (Index s = 0; s < broad_phase_->mesh().surface_count(); ++s) {
    Surface& surface = surfaces_[s];
    surface.moved = true;
    for_each_tree(*broad_phase_, s, surface, [&](const BoxTree& tree, Parts& parts, auto corners) {
      fit_nodes(
          tree, parts,
          [&](Part& part, std::span<const Index> items) {
            part.place = kEmptyBox;
            for (const Index item : items) {
              for (const Index v : corners(item)) include(part.place, reference + 3 * v);
            }
          },
          [](Part& part, const Part& p, const Part& q) { part.place = united(p.place, q.place); });
    });
  }
}

void RelativeSearch::fit_displacements(const Wanted& wanted, Index s) {
  const std::vector<Index>& vertices = broad_phase_->trees(s).vertices.items();
  const bool moves = std::ranges::any_of(vertices, [&](Index v) {
    return !row(wanted.u_t0, v).isZero(0.0) || !row(wanted.u_t1, v).isZero(0.0);
  });
  Surface& surface = surfaces_[s];
  if (!moves && !surface.moved) return;
  surface.moved = moves;
  for_each_tree(*broad_phase_, s, surface, [&](const BoxTree& tree, Parts& parts, auto corners) {
    fit_nodes(
        tree, parts,
        [&](Part& part, std::span<const Index> items) {
          part.u_t0 = part.u_t1 = kEmptyBox;
          for (const Index item : items) {
            for (const Index v : corners(item)) {
              include(part.u_t0, wanted.u_t0 + 3 * v);
              include(part.u_t1, wanted.u_t1 + 3 * v);
            }
          }
        },
        [](Part& part, const Part& p, const Part& q) {
          part.u_t0 = united(p.u_t0, q.u_t0);
          part.u_t1 = united(p.u_t1, q.u_t1);
        });
  });
}

std::size_t RelativeSearch::find(const Wanted& wanted, BroadPhase::Scratch& scratch, Found& out) {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const double least_sq = wanted.least * wanted.least;
  for (Index s = 0; s < mesh.surface_count(); ++s) fit_displacements(wanted, s);
  const auto vertex = [](Index v) { return std::array<Index, 1>{v}; };
  const auto edge = [&](Index e) { return mesh.edges[e]; };
  const auto face = [&](Index f) { return mesh.faces[f]; };
  std::size_t looked_at = 0;
  for (Index s = 0; s < mesh.surface_count(); ++s) {
    for (Index r = s; r < mesh.surface_count(); ++r) {
      if (!mesh.touching.contains(s, r)) continue;
      const double range = wanted.reach[s] + wanted.reach[r] + wanted.rounding;
      const auto offer = [&](const Candidate& pair) {
        const double moved_sq = approach_sq(pair, wanted.u_t0, wanted.u_t1);
        if (moved_sq <= least_sq) return;
        const auto& v = pair.vertices;
        const Corners corner{row(wanted.reference, v[0]), row(wanted.reference, v[1]),
                             row(wanted.reference, v[2]), row(wanted.reference, v[3])};
        const double distance = std::sqrt(distance_sq(pair.kind, corner)) - wanted.rounding;
        const double apart = distance - std::sqrt(moved_sq);
        if (apart <= range) out.push(pair, apart);
      };
      const auto visit = [&](const BoxTree& tree_a, const Parts& a, const auto& corners_a,
                             const BoxTree& tree_b, const Parts& b, const auto& corners_b,
                             const auto& visit_pair) {
        visit_leaf_pairs(
            tree_a, tree_b, scratch.stack,
            [&](Index i, Index j) { return may_meet(a[i], b[j], range, wanted.least); },
            [&](const BoxTree::Node& p, const BoxTree::Node& q) {
              if (++looked_at % kLeavesAtOnce == 0 && checkpoint_) checkpoint_->check();
              visit_items(tree_a.items_of(p), corners_a, tree_b.items_of(q), corners_b, wanted,
                          range, visit_pair);
            });
      };
      const auto find_vertices_and_faces = [&](Index p, Index q) {
        visit(broad_phase_->trees(p).vertices, surfaces_[p].vertices, vertex,
              broad_phase_->trees(q).faces, surfaces_[q].faces, face, [&](Index v, Index f) {
                if (!has_vertex(mesh.faces[f], v)) offer(candidate_of_vertex(mesh, v, f));
              });
      };
      if (broad_phase_->meet(s, r)) find_vertices_and_faces(s, r);
      if (s != r && broad_phase_->meet(r, s)) find_vertices_and_faces(r, s);
      visit(broad_phase_->trees(s).edges, surfaces_[s].edges, edge, broad_phase_->trees(r).edges,
            surfaces_[r].edges, edge, [&](Index i, Index j) {
              const auto [e, f] = std::minmax(i, j);
              if (share_vertex(mesh.edges[e], mesh.edges[f])) return;
              offer(candidate_of_edges(mesh, e, f));
            });
    }
  }
  return looked_at;
}

}  // namespace diffcloth::contact
