#include "contact/broad_phase.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <span>
#include <utility>

#include "contact/pierce.h"

namespace diffcloth::contact {
namespace {

using IndexPair = std::array<Index, 2>;
using PairList = BroadPhase::Scratch::PairList;

/// Outward rounding of a box, relative to its coordinates: covers the rounding of the box itself
/// and of positions interpolated between the ends of the motion.
constexpr double kOutward = 1e-15;

/// Rounding error of the distance lower bound in are_apart(), relative to the coordinates, rounded up.
constexpr double kAcross = 1e-14;

NearBoxes near_boxes_here() {
  static const NearBoxes best = near_boxes(linalg::chosen_level());
  return best;
}

/// Append the pairs of nearby items of two leaves. Their number is unpredictable: every pair is written,
/// and the end advances by its bit, which avoids branch mispredictions.
void append_pairs(const BoxTree& tree_a,
                  Index first_a,
                  const BoxTree& tree_b,
                  Index first_b,
                  std::uint32_t near,
                  PairList& pairs) {
  if (near == 0) return;
  IndexPair* end = pairs.room(kBoxGroup * kBoxGroup);
  // Unused slots of a leaf are near nothing; their items must not be read.
  const Index size_a = std::min<Index>(kBoxGroup, tree_a.items().size() - first_a);
  const Index size_b = std::min<Index>(kBoxGroup, tree_b.items().size() - first_b);
  const Index* const a = tree_a.items().data() + first_a;
  const Index* const b = tree_b.items().data() + first_b;
  for (Index k = 0; k < size_a; ++k) {
    for (Index l = 0; l < size_b; ++l) {
      *end = {a[k], b[l]};
      end += (near >> (kBoxGroup * k + l)) & 1U;
    }
  }
  pairs.end_at(end);
}

/// Append all (item of a, item of b) whose boxes are within range. Nodes are compared by overlap of
/// their boxes with margins alone, which costs half as much and accepts few more pairs.
void append_overlaps(const BoxTree& tree_a,
                     const BoxTree::Boxes& a,
                     const BoxTree& tree_b,
                     const BoxTree::Boxes& b,
                     double range,
                     PairList& stack,
                     PairList& pairs) {
  const NearBoxes near = near_boxes_here();
  visit_leaf_pairs(
      tree_a, tree_b, stack, [&](Index i, Index j) { return overlap(a.nodes[i], b.nodes[j]); },
      [&](const BoxTree::Node& p, const BoxTree::Node& q) {
        append_pairs(tree_a, p.first, tree_b, q.first,
                     near(a.items[p.first / kBoxGroup], b.items[q.first / kBoxGroup], range),
                     pairs);
      });
}

/// Append all unordered pairs of different items of one tree whose boxes are within range.
void append_self_overlaps(const BoxTree& tree,
                          const BoxTree::Boxes& boxes,
                          double range,
                          PairList& stack,
                          PairList& pairs) {
  constexpr std::uint32_t kAbove = 0b0000'1000'1100'1110;  // bits of l > k
  const NearBoxes near = near_boxes_here();
  visit_leaf_pairs(
      tree, tree, stack,
      [&](Index i, Index j) { return (i == j) | overlap(boxes.nodes[i], boxes.nodes[j]); },
      [&](const BoxTree::Node& p, const BoxTree::Node& q) {
        const std::uint32_t found =
            near(boxes.items[p.first / kBoxGroup], boxes.items[q.first / kBoxGroup], range);
        append_pairs(tree, p.first, tree, q.first, &p == &q ? found & kAbove : found, pairs);
      });
}

/// True if two primitives are certainly farther apart than `range`: lower bound of the distance along
/// the sum of the vectors between their corners.
template <std::size_t kCount>
bool are_apart(const std::array<Vec3, kCount>& between, double range) {
  Vec3 n = between[0];
  for (std::size_t k = 1; k < kCount; ++k) n += between[k];
  double least = n.dot(between[0]);
  for (std::size_t k = 1; k < kCount; ++k) least = std::min(least, n.dot(between[k]));
  return least > 0.0 && least * least > range * range * n.squaredNorm();
}

/// Drop the pairs that do not satisfy `keep`.
template <class Keep>
void filter(PairList& pairs, Keep&& keep) {
  IndexPair* end = pairs.begin();
  for (const IndexPair& pair : pairs) {
    *end = pair;
    end += keep(pair);
  }
  pairs.end_at(end);
}

/// Sort pairs into scratch.sorted: counted by the first index, then by the second within each of
/// these short runs.
void sort_pairs(PairList& pairs, BroadPhase::Scratch& scratch) {
  Index count = 0;
  for (const IndexPair& pair : pairs) count = std::max(count, pair[0] + 1);
  std::vector<Index>& bucket = scratch.bucket;
  bucket.assign(count + 1, 0);
  for (const IndexPair& pair : pairs) ++bucket[pair[0] + 1];
  std::partial_sum(bucket.begin(), bucket.end(), bucket.begin());
  scratch.sorted.resize(pairs.size());
  for (const IndexPair& pair : pairs) scratch.sorted[bucket[pair[0]]++] = pair;
  Index first = 0;
  for (Index a = 0; a < count; ++a) {
    const Index last = bucket[a];  // advanced to the end of its run by the loop above
    std::sort(scratch.sorted.begin() + first, scratch.sorted.begin() + last);
    first = last;
  }
}

Box point_box(const double* x, Index v) {
  const std::array<double, 3> p{x[3 * v], x[3 * v + 1], x[3 * v + 2]};
  return {.lo = p, .hi = p};
}

/// Box of a motion in a frame that translates by `frame` during the motion.
Box swept(const Box& t0, const Box& t1, const Vec3& frame, double reach) {
  Box box;
  for (int k = 0; k < 3; ++k) {
    const double lo = std::min(t0.lo[k], t1.lo[k] - frame[k]);
    const double hi = std::max(t0.hi[k], t1.hi[k] - frame[k]);
    const double size =
        std::max({std::abs(lo), std::abs(hi), std::abs(t1.lo[k]), std::abs(t1.hi[k])});
    const double margin = reach + kOutward * (reach + size);
    box.lo[k] = lo - margin;
    box.hi[k] = hi + margin;
  }
  return box;
}

/// Largest absolute coordinate of all surfaces at the start of a search.
double largest_coordinate(const BroadPhase::Scratch& scratch) {
  double largest = 0.0;
  for (const BroadPhase::Scratch::Surface& surface : scratch.surfaces) {
    for (int k = 0; k < 3; ++k) {
      largest = std::max({largest, -surface.box_t0.lo[k], surface.box_t0.hi[k]});
    }
  }
  return largest;
}

}  // namespace

BroadPhase::BroadPhase(const CollisionMesh& mesh, const double* x_reference) : mesh_(mesh) {
  const auto center = [&](std::span<const Index> corners) -> Vec3 {
    Vec3 sum = Vec3::Zero();
    for (const Index v : corners) sum += row(x_reference, v);
    return sum / static_cast<double>(corners.size());
  };
  const auto tree_of = [&](const auto& elements, const std::vector<Index>& surface_of,
                           Index surface) {
    std::vector<Index> ids;
    std::vector<Vec3> centers;
    for (std::size_t k = 0; k < elements.size(); ++k) {
      if (surface_of[k] != surface) continue;
      ids.push_back(static_cast<Index>(k));
      centers.push_back(center(elements[k]));
    }
    return BoxTree(std::move(ids), centers);
  };
  // Vertices without a face bound nothing: no tree contains them.
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

/// Boxes around the surfaces at both ends, and their mean motions.
void BroadPhase::measure_motion(const Sweep& sweep, Scratch& scratch) const {
  scratch.vertex_boxes.resize(mesh_.vertex_count);
  scratch.surfaces.resize(trees_.size());
  for (std::size_t s = 0; s < trees_.size(); ++s) {
    Scratch::Surface& surface = scratch.surfaces[s];
    surface.fitted = false;
    surface.box_t0 = surface.box_t1 = kEmptyBox;
    Vec3 sum = Vec3::Zero();
    for (const Index v : trees_[s].vertices.items()) {
      surface.box_t0 = united(surface.box_t0, point_box(sweep.x_t0, v));
      surface.box_t1 = united(surface.box_t1, point_box(sweep.x_t1, v));
      sum += row(sweep.x_t1, v) - row(sweep.x_t0, v);
    }
    const auto count = static_cast<double>(trees_[s].vertices.items().size());
    const Vec3 mean = count > 0 ? Vec3(sum / count) : Vec3::Zero();
    // A mean motion within the reach saves little in a moving frame, but requires refitted boxes. A
    // motion that is not finite gets no frame.
    surface.motion =
        mean.allFinite() && mean.cwiseAbs().maxCoeff() > sweep.reach[s] ? mean : Vec3::Zero();
  }
}

void BroadPhase::fit(const Sweep& sweep, Index surface, const Vec3& frame, Scratch& scratch) const {
  Scratch::Surface& boxes = scratch.surfaces[surface];
  if (boxes.fitted && boxes.frame == frame) return;
  const SurfaceTrees& trees = trees_[surface];
  for (const Index v : trees.vertices.items()) {
    scratch.vertex_boxes[v] =
        swept(point_box(sweep.x_t0, v), point_box(sweep.x_t1, v), frame, sweep.reach[surface]);
  }
  const std::vector<Box>& of_vertex = scratch.vertex_boxes;
  if (sweep.of_vertices) trees.vertices.fit(boxes.vertices, [&](Index v) { return of_vertex[v]; });
  trees.edges.fit(boxes.edges, [&](Index e) {
    const auto& [i, j] = mesh_.edges[e];
    return united(of_vertex[i], of_vertex[j]);
  });
  trees.faces.fit(boxes.faces, [&](Index f) {
    const auto& [i, j, k] = mesh_.faces[f];
    return united(united(of_vertex[i], of_vertex[j]), of_vertex[k]);
  });
  boxes.frame = frame;
  boxes.fitted = true;
}

template <class Visit>
void BroadPhase::visit_surface_pairs(const Sweep& sweep, Scratch& scratch, Visit&& visit) const {
  measure_motion(sweep, scratch);
  const auto surface_count = static_cast<Index>(trees_.size());
  for (Index s = 0; s < surface_count; ++s) {
    for (Index r = s; r < surface_count; ++r) {
      if (!mesh_.touching.contains(s, r)) continue;
      const Scratch::Surface& a = scratch.surfaces[s];
      const Scratch::Surface& b = scratch.surfaces[r];
      const Vec3 frame = r < mesh_.cloth_count ? a.motion : b.motion;
      if (!overlap(swept(a.box_t0, a.box_t1, frame, sweep.reach[s]),
                   swept(b.box_t0, b.box_t1, frame, sweep.reach[r]))) {
        continue;
      }
      fit(sweep, s, frame, scratch);
      fit(sweep, r, frame, scratch);
      visit(s, r);
    }
  }
}

/// Unordered index pairs whose boxes are near each other, without pairs that share a vertex.
void BroadPhase::collect_pairs(const Sweep& sweep, Scratch& scratch) const {
  PairList& vertex_faces = scratch.vertex_face_pairs;
  PairList& edges = scratch.edge_pairs;
  vertex_faces.clear();
  edges.clear();
  visit_surface_pairs(sweep, scratch, [&](Index s, Index r) {
    const Scratch::Surface& a = scratch.surfaces[s];
    const Scratch::Surface& b = scratch.surfaces[r];
    // Rounded up, as the boxes are rounded outward.
    const double range = (1.0 + kOutward) * (sweep.reach[s] + sweep.reach[r]);
    if (meet(s, r)) {
      append_overlaps(trees_[s].vertices, a.vertices, trees_[r].faces, b.faces, range,
                      scratch.stack, vertex_faces);
    }
    if (s == r) {
      append_self_overlaps(trees_[s].edges, a.edges, range, scratch.stack, edges);
      return;
    }
    if (meet(r, s)) {
      append_overlaps(trees_[r].vertices, b.vertices, trees_[s].faces, a.faces, range,
                      scratch.stack, vertex_faces);
    }
    append_overlaps(trees_[s].edges, a.edges, trees_[r].edges, b.edges, range, scratch.stack,
                    edges);
  });
  filter(vertex_faces, [&](const IndexPair& p) { return !has_vertex(mesh_.faces[p[1]], p[0]); });
  filter(edges,
         [&](const IndexPair& p) { return !share_vertex(mesh_.edges[p[0]], mesh_.edges[p[1]]); });
}

/// Remove the collected pairs that are certainly beyond their reaches at x, the start of the sweep.
void BroadPhase::drop_distant(const double* x,
                              std::span<const double> reach,
                              Scratch& scratch) const {
  const double rounding = kAcross * largest_coordinate(scratch);
  filter(scratch.vertex_face_pairs, [&](const IndexPair& pair) {
    const auto& [v, f] = pair;
    const auto& [i, j, k] = mesh_.faces[f];
    const Vec3 p = row(x, v);
    const double range = reach[mesh_.vertex_surface[v]] + reach[mesh_.face_surface[f]] + rounding;
    return !are_apart<3>({p - row(x, i), p - row(x, j), p - row(x, k)}, range);
  });
  filter(scratch.edge_pairs, [&](const IndexPair& pair) {
    const auto& [e, f] = pair;
    const auto& [i, j] = mesh_.edges[e];
    const auto& [k, l] = mesh_.edges[f];
    const Vec3 p = row(x, i);
    const Vec3 q = row(x, j);
    const double range = reach[mesh_.edge_surface[e]] + reach[mesh_.edge_surface[f]] + rounding;
    return !are_apart<4>({p - row(x, k), p - row(x, l), q - row(x, k), q - row(x, l)}, range);
  });
}

/// Write the collected pairs as sorted candidates.
void BroadPhase::write_pairs(Scratch& scratch, std::vector<Candidate>& out) const {
  out.clear();
  sort_pairs(scratch.vertex_face_pairs, scratch);
  for (const auto& [v, f] : scratch.sorted) out.push_back(candidate_of_vertex(mesh_, v, f));
  PairList& edges = scratch.edge_pairs;
  for (IndexPair& pair : edges) pair = {std::min(pair[0], pair[1]), std::max(pair[0], pair[1])};
  sort_pairs(edges, scratch);
  for (const auto& [e, f] : scratch.sorted) out.push_back(candidate_of_edges(mesh_, e, f));
}

void BroadPhase::find(const double* x_t0,
                      const double* x_t1,
                      std::span<const double> reach,
                      Scratch& scratch,
                      std::vector<Candidate>& out) const {
  collect_pairs({.x_t0 = x_t0, .x_t1 = x_t1, .reach = reach}, scratch);
  write_pairs(scratch, out);
}

void BroadPhase::find_at_rest(const double* x,
                              std::span<const double> reach,
                              Scratch& scratch,
                              std::vector<Candidate>& out) const {
  collect_pairs({.x_t0 = x, .x_t1 = x, .reach = reach}, scratch);
  drop_distant(x, reach, scratch);
  write_pairs(scratch, out);
}

std::optional<std::pair<Index, Index>> BroadPhase::find_intersection(const double* x,
                                                                     Scratch& scratch) const {
  const std::vector<double> reach(trees_.size(), 0.0);
  PairList pairs;  // (edge, face); many, and not needed at every step
  const Sweep sweep{.x_t0 = x, .x_t1 = x, .reach = reach, .of_vertices = false};
  visit_surface_pairs(sweep, scratch, [&](Index s, Index r) {
    const Scratch::Surface& a = scratch.surfaces[s];
    const Scratch::Surface& b = scratch.surfaces[r];
    // Skeletons have no interior that an edge could pierce.
    if (!mesh_.is_round(r)) {
      append_overlaps(trees_[s].edges, a.edges, trees_[r].faces, b.faces, 0.0, scratch.stack,
                      pairs);
    }
    if (s == r || mesh_.is_round(s)) return;
    append_overlaps(trees_[r].edges, b.edges, trees_[s].faces, a.faces, 0.0, scratch.stack, pairs);
  });
  filter(pairs, [&](const IndexPair& pair) {
    const auto& [i, j] = mesh_.edges[pair[0]];
    const CollisionMesh::Face& face = mesh_.faces[pair[1]];
    return !(has_vertex(face, i) | has_vertex(face, j));
  });
  std::optional<std::pair<Index, Index>> lowest;
  for (const auto& [e, f] : pairs) {
    const auto& [i, j] = mesh_.edges[e];
    const CollisionMesh::Face& face = mesh_.faces[f];
    if (lowest && *lowest < std::pair(e, f)) continue;
    if (pierces(row(x, i), row(x, j), row(x, face[0]), row(x, face[1]), row(x, face[2]))) {
      lowest = {e, f};
    }
  }
  return lowest;
}

}  // namespace diffcloth::contact
