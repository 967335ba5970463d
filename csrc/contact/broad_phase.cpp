#include "contact/broad_phase.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <span>

#include "contact/pierce.h"

namespace diffcloth::contact {
namespace {

using IndexPair = std::array<Index, 2>;
using Stack = std::vector<IndexPair>;

/// Outward rounding of a box, relative to its coordinates: covers the rounding of the box itself and
/// of positions interpolated between the ends of the motion.
constexpr double kOutward = 1e-15;

bool share_vertex(const CollisionMesh::Edge& e, const CollisionMesh::Edge& f) {
  return e[0] == f[0] || e[0] == f[1] || e[1] == f[0] || e[1] == f[1];
}

bool has_vertex(const CollisionMesh::Face& face, Index v) {
  return face[0] == v || face[1] == v || face[2] == v;
}

/// Visit all items of two trees whose boxes overlap.
template <class Visit>
void visit_overlaps(const BoxTree& tree_a,
                    const BoxTree::Boxes& a,
                    const BoxTree& tree_b,
                    const BoxTree::Boxes& b,
                    Stack& stack,
                    Visit&& visit) {
  if (tree_a.empty() || tree_b.empty() || !overlap(a.nodes[0], b.nodes[0])) return;
  stack.clear();
  stack.push_back({0, 0});
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    const BoxTree::Node& node_a = tree_a.nodes()[i];
    const BoxTree::Node& node_b = tree_b.nodes()[j];
    if (node_a.left == 0 && node_b.left == 0) {
      for (Index k = node_a.first; k < node_a.last; ++k) {
        for (Index l = node_b.first; l < node_b.last; ++l) {
          if (overlap(a.items[k], b.items[l])) visit(tree_a.items()[k], tree_b.items()[l]);
        }
      }
      continue;
    }
    const bool split_a =
        node_b.left == 0 ||
        (node_a.left != 0 && node_a.last - node_a.first >= node_b.last - node_b.first);
    for (Index child = 0; child < 2; ++child) {
      const Index next_i = split_a ? node_a.left + child : i;
      const Index next_j = split_a ? j : node_b.left + child;
      if (overlap(a.nodes[next_i], b.nodes[next_j])) stack.push_back({next_i, next_j});
    }
  }
}

/// Visit all unordered pairs of different items of one tree whose boxes overlap.
template <class Visit>
void visit_self_overlaps(const BoxTree& tree,
                         const BoxTree::Boxes& boxes,
                         Stack& stack,
                         Visit&& visit) {
  if (tree.empty()) return;
  const auto visit_items = [&](Index k, Index l) {
    if (overlap(boxes.items[k], boxes.items[l])) visit(tree.items()[k], tree.items()[l]);
  };
  stack.clear();
  stack.push_back({0, 0});
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    const BoxTree::Node& p = tree.nodes()[i];
    const BoxTree::Node& q = tree.nodes()[j];
    if (i == j && p.left == 0) {
      for (Index k = p.first; k < p.last; ++k) {
        for (Index l = k + 1; l < p.last; ++l) visit_items(k, l);
      }
    } else if (i == j) {
      stack.push_back({p.left, p.left});
      stack.push_back({p.left + 1, p.left + 1});
      if (overlap(boxes.nodes[p.left], boxes.nodes[p.left + 1])) {
        stack.push_back({p.left, p.left + 1});
      }
    } else if (p.left == 0 && q.left == 0) {
      for (Index k = p.first; k < p.last; ++k) {
        for (Index l = q.first; l < q.last; ++l) visit_items(k, l);
      }
    } else {
      const bool split_p = q.left == 0 || (p.left != 0 && p.last - p.first >= q.last - q.first);
      for (Index child = 0; child < 2; ++child) {
        const Index next_i = split_p ? p.left + child : i;
        const Index next_j = split_p ? j : q.left + child;
        if (overlap(boxes.nodes[next_i], boxes.nodes[next_j])) stack.push_back({next_i, next_j});
      }
    }
  }
}

/// Sort scratch.pairs into scratch.sorted: counted by the first index (below `count`), then by the
/// second within each of these short runs.
void sort_pairs(Index count, BroadPhase::Scratch& scratch) {
  std::vector<Index>& bucket = scratch.bucket;
  bucket.assign(count + 1, 0);
  for (const IndexPair& pair : scratch.pairs) ++bucket[pair[0] + 1];
  std::partial_sum(bucket.begin(), bucket.end(), bucket.begin());
  scratch.sorted.resize(scratch.pairs.size());
  for (const IndexPair& pair : scratch.pairs) scratch.sorted[bucket[pair[0]]++] = pair;
  Index first = 0;
  for (Index a = 0; a < count; ++a) {
    const Index last = bucket[a];  // moved on to the end of its run by the loop above
    std::sort(scratch.sorted.begin() + first, scratch.sorted.begin() + last);
    first = last;
  }
}

}  // namespace

BroadPhase::BroadPhase(const CollisionMesh& mesh, const double* x_reference) : mesh_(mesh) {
  const auto center = [&](std::span<const Index> corners) -> Vec3 {
    Vec3 sum = Vec3::Zero();
    for (const Index v : corners) sum += row(x_reference, v);
    return sum / static_cast<double>(corners.size());
  };
  const auto tree_of = [&](const auto& elements, const std::vector<Index>& surface_of, Index surface) {
    std::vector<Index> ids;
    std::vector<Vec3> centers;
    for (std::size_t k = 0; k < elements.size(); ++k) {
      if (surface_of[k] != surface) continue;
      ids.push_back(static_cast<Index>(k));
      centers.push_back(center(elements[k]));
    }
    return BoxTree(std::move(ids), centers);
  };
  // Vertices without a face bound nothing: they belong to no surface here.
  std::vector<Index> used_surface(mesh_.vertex_count, -1);
  std::vector<std::array<Index, 1>> vertices(mesh_.vertex_count);
  for (Index v = 0; v < mesh_.vertex_count; ++v) vertices[v] = {v};
  for (const CollisionMesh::Face& face : mesh_.faces) {
    for (const Index v : face) used_surface[v] = mesh_.vertex_surface[v];
  }
  for (Index surface = 0; surface < mesh_.surface_count(); ++surface) {
    trees_.push_back({.vertices = tree_of(vertices, used_surface, surface),
                      .edges = tree_of(mesh_.edges, mesh_.edge_surface, surface),
                      .faces = tree_of(mesh_.faces, mesh_.face_surface, surface)});
  }
}

void BroadPhase::sweep(const double* x_t0,
                       const double* x_t1,
                       double radius,
                       Scratch& scratch) const {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  scratch.vertex_boxes.resize(mesh_.vertex_count);
  scratch.surfaces.resize(trees_.size());
  for (Scratch::Surface& surface : scratch.surfaces) {
    surface.fitted = false;
    surface.box = {.lo = {kInfinity, kInfinity, kInfinity},
                   .hi = {-kInfinity, -kInfinity, -kInfinity}};
  }
  const double half = 0.5 * radius;
  for (Index v = 0; v < mesh_.vertex_count; ++v) {
    Box& box = scratch.vertex_boxes[v];
    for (int k = 0; k < 3; ++k) {
      const double p = x_t0[3 * v + k];
      const double q = x_t1[3 * v + k];
      const double margin = half + kOutward * (half + std::max(std::abs(p), std::abs(q)));
      box.lo[k] = std::min(p, q) - margin;
      box.hi[k] = std::max(p, q) + margin;
    }
    Box& around = scratch.surfaces[mesh_.vertex_surface[v]].box;
    around = united(around, box);
  }
}

void BroadPhase::fit(Index surface, Scratch& scratch) const {
  Scratch::Surface& boxes = scratch.surfaces[surface];
  if (boxes.fitted) return;
  const SurfaceTrees& trees = trees_[surface];
  const auto fit_tree = [&](const BoxTree& tree, BoxTree::Boxes& target, auto&& box_of) {
    target.items.resize(tree.items().size());
    for (std::size_t k = 0; k < target.items.size(); ++k) target.items[k] = box_of(tree.items()[k]);
    tree.refit(target);
  };
  const std::vector<Box>& of_vertex = scratch.vertex_boxes;
  fit_tree(trees.vertices, boxes.vertices, [&](Index v) { return of_vertex[v]; });
  fit_tree(trees.edges, boxes.edges, [&](Index e) {
    const auto& [i, j] = mesh_.edges[e];
    return united(of_vertex[i], of_vertex[j]);
  });
  fit_tree(trees.faces, boxes.faces, [&](Index f) {
    const auto& [i, j, k] = mesh_.faces[f];
    return united(united(of_vertex[i], of_vertex[j]), of_vertex[k]);
  });
  boxes.fitted = true;
}

template <class Visit>
void BroadPhase::visit_surface_pairs(Scratch& scratch, Visit&& visit) const {
  const Index surface_count = static_cast<Index>(trees_.size());
  for (Index s = 0; s < mesh_.cloth_count; ++s) {
    for (Index r = mesh_.self_contact ? s : s + 1; r < surface_count; ++r) {
      if (!overlap(scratch.surfaces[s].box, scratch.surfaces[r].box)) continue;
      fit(s, scratch);
      fit(r, scratch);
      visit(s, r);
    }
  }
}

void BroadPhase::find(const double* x_t0,
                      const double* x_t1,
                      double radius,
                      Scratch& scratch,
                      std::vector<Candidate>& out) const {
  out.clear();
  sweep(x_t0, x_t1, radius, scratch);

  scratch.pairs.clear();
  const auto keep_vertex_face = [&](Index v, Index f) {
    if (!has_vertex(mesh_.faces[f], v)) scratch.pairs.push_back({v, f});
  };
  visit_surface_pairs(scratch, [&](Index s, Index r) {
    const Scratch::Surface& a = scratch.surfaces[s];
    const Scratch::Surface& b = scratch.surfaces[r];
    visit_overlaps(trees_[s].vertices, a.vertices, trees_[r].faces, b.faces, scratch.stack,
                   keep_vertex_face);
    if (s == r) return;
    visit_overlaps(trees_[r].vertices, b.vertices, trees_[s].faces, a.faces, scratch.stack,
                   keep_vertex_face);
  });
  sort_pairs(mesh_.vertex_count, scratch);
  for (const auto& [v, f] : scratch.sorted) {
    const auto& [i, j, k] = mesh_.faces[f];
    out.push_back({.kind = PairKind::kPointTriangle, .vertices = {v, i, j, k}, .a = v, .b = f});
  }

  scratch.pairs.clear();
  const auto keep_edges = [&](Index e, Index f) {
    if (!share_vertex(mesh_.edges[e], mesh_.edges[f])) {
      scratch.pairs.push_back({std::min(e, f), std::max(e, f)});
    }
  };
  visit_surface_pairs(scratch, [&](Index s, Index r) {
    const BoxTree::Boxes& a = scratch.surfaces[s].edges;
    const BoxTree::Boxes& b = scratch.surfaces[r].edges;
    if (s == r) {
      visit_self_overlaps(trees_[s].edges, a, scratch.stack, keep_edges);
    } else {
      visit_overlaps(trees_[s].edges, a, trees_[r].edges, b, scratch.stack, keep_edges);
    }
  });
  sort_pairs(mesh_.cloth_edge_count, scratch);  // the lower edge belongs to a cloth
  for (const auto& [e, f] : scratch.sorted) {
    const auto& [i, j] = mesh_.edges[e];
    const auto& [k, l] = mesh_.edges[f];
    out.push_back({.kind = PairKind::kEdgeEdge, .vertices = {i, j, k, l}, .a = e, .b = f});
  }
}

std::optional<std::pair<Index, Index>> BroadPhase::find_intersection(const double* x,
                                                                     Scratch& scratch) const {
  sweep(x, x, 0, scratch);
  std::optional<std::pair<Index, Index>> lowest;
  const auto test = [&](Index e, Index f) {
    const CollisionMesh::Edge& edge = mesh_.edges[e];
    const CollisionMesh::Face& face = mesh_.faces[f];
    if (lowest && *lowest < std::pair(e, f)) return;
    if (has_vertex(face, edge[0]) || has_vertex(face, edge[1])) return;
    if (pierces(row(x, edge[0]), row(x, edge[1]), row(x, face[0]), row(x, face[1]),
                row(x, face[2]))) {
      lowest = {e, f};
    }
  };
  visit_surface_pairs(scratch, [&](Index s, Index r) {
    const Scratch::Surface& a = scratch.surfaces[s];
    const Scratch::Surface& b = scratch.surfaces[r];
    visit_overlaps(trees_[s].edges, a.edges, trees_[r].faces, b.faces, scratch.stack, test);
    if (s == r) return;
    visit_overlaps(trees_[r].edges, b.edges, trees_[s].faces, a.faces, scratch.stack, test);
  });
  return lowest;
}

}  // namespace diffcloth::contact
