#include "contact/merge.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <tuple>

#include "contact/distance/closest.h"
#include "contact/distance/mollifier.h"

namespace diffcloth::contact {
namespace {

using Part = MergeScratch::Part;
using NearEdge = MergeScratch::NearEdge;

/// Tolerance within which a projection counts as on the border, relative to the size of a triangle or
/// edge, or to the distance of the point if larger. Without it two faces at an edge, each with its own
/// rounding, could both contain the projection of the same point. The error of the distance is of the
/// order of the squared tolerance, below rounding.
constexpr double kBorder = 1e-12;

/// Squared distances that differ by this factor differ by more than rounding.
constexpr double kClearly = 1.0 + 1e-12;

/// Squared sine of an angle below which a triangle is a sliver, whose closest point closest_points()
/// may place on an edge.
constexpr double kThinnest = 1e-6;

enum Kind : std::int8_t { kVertex, kEdge, kFace, kMollified };

NearEdge nearest_on_edge(const CollisionMesh& mesh, Index edge, const Vec3& p, const double* x) {
  const auto& [i, j] = mesh.edges[edge];
  const Vec3 e = row(x, j) - row(x, i);
  const Vec3 w = p - row(x, i);
  const double along = w.dot(e);
  const double length_sq = e.squaredNorm();
  const double border = kBorder * std::sqrt(length_sq * std::max(length_sq, w.squaredNorm()));
  if (along <= border) return {.edge = edge, .vertex = i, .d_sq = w.squaredNorm()};
  if (along >= length_sq - border) {
    return {.edge = edge, .vertex = j, .d_sq = (p - row(x, j)).squaredNorm()};
  }
  return {.edge = edge, .vertex = -1, .d_sq = (w - (along / length_sq) * e).squaredNorm()};
}

/// True if edge a of a triangle is nearer than edge b. At equal distance to rounding, the inside of an
/// edge precedes the end of another edge.
bool is_nearer(const NearEdge& a, const NearEdge& b) {
  constexpr double kTie = 1e-15;
  const double tie = static_cast<int>(a.vertex < 0) * kTie - static_cast<int>(b.vertex < 0) * kTie;
  return a.d_sq < b.d_sq * (1.0 + tie);
}

/// Faces whose normals differ by a smaller angle [rad] are coplanar.
constexpr double kCoplanar = 1e-9;

Vec3 normal(const CollisionMesh& mesh, Index f, const double* x) {
  const auto& [i, j, k] = mesh.faces[f];
  return (row(x, j) - row(x, i)).cross(row(x, k) - row(x, i));
}

/// True if a face and its only neighbor at an edge lie in one plane.
bool is_flat(const CollisionMesh& mesh,
             const FeatureWeights::Features& features,
             Index face,
             Index edge,
             const double* x) {
  constexpr Index kTwoFaces = -1;
  if (features.edge[edge] != kTwoFaces) return false;
  const auto& [f, g] = mesh.edge_faces[edge];
  const Vec3 n = normal(mesh, face, x);
  const Vec3 m = normal(mesh, f == face ? g : f, x);
  return n.cross(m).squaredNorm() <= kCoplanar * kCoplanar * n.squaredNorm() * m.squaredNorm();
}

enum class Projection : std::uint8_t { kOutside, kInside, kOnFlatBorder };

/// Locate a point's projection on the plane of a face; unless outside, also compute its squared
/// distance.
///
/// On a border between two coplanar faces the point belongs to the plane, not to an edge: the second
/// derivatives of the distance from that edge do not belong to this surface.
Projection project(const CollisionMesh& mesh,
                   const FeatureWeights::Features& features,
                   Index face,
                   const Vec3& p,
                   const double* x,
                   double& d_sq) {
  const auto& [i, j, k] = mesh.faces[face];
  const Vec3 e0 = row(x, j) - row(x, i);
  const Vec3 e1 = row(x, k) - row(x, i);
  const Vec3 w = p - row(x, i);
  const Vec3 n = e0.cross(e1);
  const double n_sq = n.squaredNorm();
  const double b0 = w.cross(e1).dot(n);
  const double b1 = e0.cross(w).dot(n);
  const double longest_sq = std::max(e0.squaredNorm(), e1.squaredNorm());
  const double least = kBorder * std::sqrt(n_sq * std::max(n_sq, longest_sq * w.squaredNorm()));
  // In units of 1 / |n|^2, for the sides in the order of the face's edges.
  const std::array<double, 3> from_side{b1, n_sq - b0 - b1, b0};
  Projection result = Projection::kInside;
  for (int side = 0; side < 3; ++side) {
    if (from_side[side] > least) continue;
    if (from_side[side] < -least ||
        !is_flat(mesh, features, face, mesh.face_edges[face][side], x)) {
      return Projection::kOutside;
    }
    result = Projection::kOnFlatBorder;
  }
  const ClosestPoints geometry =
      closest_points(PairKind::kPointTriangle, {p, row(x, i), row(x, j), row(x, k)});
  if (geometry.parameter_count != 2) return Projection::kOutside;
  d_sq = geometry.d_sq;
  return result;
}

/// Squared distance of a point from a triangle that contains its projection, with the bits of
/// closest_points(), if the point is farther than `range` from all edges: the interior then is the only
/// feature within `range`.
std::optional<double> far_inside(
    const Vec3& p, const Vec3& a, const Vec3& b, const Vec3& c, double range) {
  const Vec3 e0 = b - a;
  const Vec3 e1 = c - a;
  const Vec3 w = p - a;
  const Vec3 n = e0.cross(e1);
  const double n_sq = n.squaredNorm();
  const double b0 = w.cross(e1).dot(n);
  const double b1 = e0.cross(w).dot(n);
  // The in-plane distance to a side is from_side / (|n| |side|).
  const double least = 2.0 * range * std::sqrt(n_sq);
  const auto is_clear = [&](double from_side, const Vec3& side) {
    return from_side > 0.0 && from_side * from_side > least * least * side.squaredNorm();
  };
  if (!is_clear(b1, e0) || !is_clear(b0, e1) || !is_clear(n_sq - b0 - b1, e1 - e0)) return {};
  const bool is_sliver = !(n_sq > kThinnest * e0.squaredNorm() * e1.squaredNorm());
  if (is_sliver) return closest_points(PairKind::kPointTriangle, {p, a, b, c}).d_sq;
  const Vec3 t = w - b0 / n_sq * e0 - b1 / n_sq * e1;
  return t.squaredNorm();
}

bool is_beyond(const Vec3& p, const Vec3& a, const Vec3& b, const Vec3& c, double range) {
  for (int k = 0; k < 3; ++k) {
    if (p[k] < std::min({a[k], b[k], c[k]}) - range) return true;
    if (p[k] > std::max({a[k], b[k], c[k]}) + range) return true;
  }
  return false;
}

bool is_beyond(const Corners& x, double range) {
  for (int k = 0; k < 3; ++k) {
    const auto [lo_a, hi_a] = std::minmax(x[0][k], x[1][k]);
    const auto [lo_b, hi_b] = std::minmax(x[2][k], x[3][k]);
    if (lo_a > hi_b + range || lo_b > hi_a + range) return true;
  }
  return false;
}

/// Sum the parts of each feature; drop parts beyond range and sums of zero.
void merge(std::vector<Part>& parts, double range) {
  const auto key = [](const Part& p) { return std::tuple(p.kind, p.id, p.ends[1], p.ends[0]); };
  std::erase_if(parts, [&](const Part& p) { return !(p.d_sq < range * range); });
  // Sums of few integers or products of single-precision numbers: exact in any order.
  std::ranges::sort(parts, {}, key);
  std::size_t count = 0;
  for (const Part& p : parts) {
    if (count > 0 && key(parts[count - 1]) == key(p)) {
      parts[count - 1].coefficient += p.coefficient;
    } else {
      parts[count++] = p;
    }
  }
  parts.resize(count);
  std::erase_if(parts, [](const Part& p) { return p.coefficient == 0.0; });
}

/// Weight of edge c against a body's edge e.
double weight(const CollisionMesh& mesh, const FeatureWeights& weights, Index c, Index e) {
  const Index surface = mesh.edge_surface[c];
  return surface < mesh.cloth_count ? weights.edge_sharpness(surface, e)
                                    : weights.edge_pair_area(c, e);
}

/// End of an edge that has the full weight of its closest point; -1 if both ends have weight.
std::int8_t end_of(double c0, double c1) {
  if (c1 == 0.0) return 0;
  return c0 == 0.0 ? std::int8_t{1} : std::int8_t{-1};
}

template <class Values>
void sort_unique(Values& values) {
  std::ranges::sort(values);
  values.erase(std::unique(values.begin(), values.end()), values.end());
}

// Merging of parts, in a section across two faces f and g that meet in an edge e. Each face contributes
// its point nearest to p, and each edge and vertex its own, with the weights of FeatureWeights:
//
//           p                      p above f                       p above e
//           .                      face f    +1 f                  face f    +1 e
//           .                      face g    +1 e                  face g    +1 e
//     ------+------e               edge e    -1 e   (1 - 2 faces)  edge e    -1 e
//        f          \              ------------------              ------------------
//                  g \ .           sum       +1 f                  sum       +1 e
//
// Similarly for edges c and c' of a body that continue each other in a vertex v, against an edge e to
// which v is nearest. Each contributes as a whole, minus half of each continued end:
//
//     ====c=====v=====c'====       c,  whole  +1 (v, e)   its end  -1/2 (v, e)
//               .                  c', whole  +1 (v, e)   its end  -1/2 (v, e)
//               e                  sum        +1 (v, e)
//
// The nearest feature therefore counts once, regardless of the triangulation; all others cancel.

/// Find the faces of a group that are within range of a point, and their edges.
void find_faces_and_edges(const CollisionMesh& mesh,
                          const FeatureWeights::Features& features,
                          std::span<const Candidate> group,
                          const double* x,
                          double range,
                          MergeScratch& scratch) {
  const Vec3 p = row(x, group.front().a);
  auto& [faces, edges, vertices, parts] = scratch;
  faces.clear();
  for (const Candidate& pair : group) {
    const auto& [self, i, j, k] = pair.vertices;
    if (features.counts[pair.b] == 0 || is_beyond(p, row(x, i), row(x, j), row(x, k), range))
      continue;
    faces.push_back(pair.b);
  }
  // A feature within range has all of its faces within range, so that the features of these faces are
  // complete.
  vertices.clear();
  for (const Index f : faces) {
    vertices.insert(vertices.end(), mesh.face_edges[f].begin(), mesh.face_edges[f].end());
  }
  sort_unique(vertices);
  edges.clear();
  for (const Index e : vertices) edges.push_back(nearest_on_edge(mesh, e, p, x));
  vertices.clear();
}

void find_vertices(const CollisionMesh& mesh, MergeScratch& scratch) {
  auto& [faces, edges, vertices, parts] = scratch;
  for (const Index f : faces) {
    vertices.insert(vertices.end(), mesh.faces[f].begin(), mesh.faces[f].end());
  }
  sort_unique(vertices);
}

/// Parts of a point against faces alone.
void list_face_parts(const CollisionMesh& mesh,
                     const FeatureWeights::Features& features,
                     const Vec3& p,
                     const double* x,
                     MergeScratch& scratch) {
  scratch.parts.clear();
  for (const Index f : scratch.faces) {
    double d_sq = 0.0;
    if (project(mesh, features, f, p, x, d_sq) != Projection::kInside) continue;
    scratch.parts.push_back(
        {.kind = kFace, .ends = {-1, -1}, .id = f, .coefficient = 1.0, .d_sq = d_sq});
  }
}

/// Parts of a point against each of the features found.
void list_point_parts(const CollisionMesh& mesh,
                      const FeatureWeights::Features& features,
                      const Vec3& p,
                      const double* x,
                      MergeScratch& scratch) {
  auto& [faces, edges, vertices, parts] = scratch;
  parts.clear();
  const auto push_on_edge = [&parts](const NearEdge& near, Index weight) {
    const bool inside = near.vertex < 0;
    parts.push_back({.kind = inside ? kEdge : kVertex,
                     .ends = {-1, -1},
                     .id = inside ? near.edge : near.vertex,
                     .coefficient = static_cast<double>(weight),
                     .d_sq = near.d_sq});
  };
  const auto near_edge = [&edges](Index e) -> const NearEdge& {
    return *std::ranges::lower_bound(edges, e, {}, &NearEdge::edge);
  };
  for (const Index f : faces) {
    double d_sq = 0.0;
    if (project(mesh, features, f, p, x, d_sq) == Projection::kInside) {
      parts.push_back({.kind = kFace, .ends = {-1, -1}, .id = f, .coefficient = 1.0, .d_sq = d_sq});
      continue;
    }
    const auto& [first, second, third] = mesh.face_edges[f];
    const NearEdge* nearest = &near_edge(first);
    for (const Index e : {second, third}) {
      if (is_nearer(near_edge(e), *nearest)) nearest = &near_edge(e);
    }
    push_on_edge(*nearest, 1);
  }
  for (const NearEdge& near : edges) push_on_edge(near, features.edge[near.edge]);
  for (const Index v : vertices) {
    parts.push_back({.kind = kVertex,
                     .ends = {-1, -1},
                     .id = v,
                     .coefficient = static_cast<double>(features.vertex[v]),
                     .d_sq = (p - row(x, v)).squaredNorm()});
  }
}

/// Assign the remaining part of a border between coplanar faces to the first face that contains the
/// projection.
void move_to_plane(const CollisionMesh& mesh,
                   const FeatureWeights::Features& features,
                   const std::vector<Index>& faces,
                   const Vec3& p,
                   const double* x,
                   Part& part) {
  for (const Index f : faces) {
    if (part.kind == kFace) break;
    const bool has =
        part.kind == kEdge
            ? std::ranges::find(mesh.face_edges[f], part.id) != mesh.face_edges[f].end()
            : std::ranges::find(mesh.faces[f], part.id) != mesh.faces[f].end();
    if (!has) continue;
    double d_sq = 0.0;
    if (project(mesh, features, f, p, x, d_sq) != Projection::kOnFlatBorder) continue;
    part.kind = kFace;
    part.id = f;
    part.d_sq = d_sq;
  }
}

/// Pair of a point and the feature of a part.
Candidate point_pair(const CollisionMesh& mesh, Index point, const Part& part) {
  Candidate pair{.kind = PairKind::kPointTriangle,
                 .vertices = {point, part.id, part.id, part.id},
                 .a = point,
                 .b = -1};
  if (part.kind == kFace) {
    const auto& [i, j, k] = mesh.faces[part.id];
    pair.vertices = {point, i, j, k};
    pair.b = part.id;
  } else if (part.kind == kEdge) {
    const auto& [i, j] = mesh.edges[part.id];
    pair.vertices = {point, i, j, j};
  }
  return pair;
}

/// One edge c against one edge e of a body, with their parts.
class EdgePair {
 public:
  EdgePair(const CollisionMesh& mesh,
           const FeatureWeights& weights,
           const Candidate& pair,
           const ClosestPoints& nearest_points,
           const Corners& corner,
           bool soft,
           const double* x,
           std::vector<Part>& parts)
      : mesh_(mesh),
        weights_(weights),
        pair_(pair),
        nearest_points_(nearest_points),
        corner_(corner),
        against_cloth_(pair.a < mesh.cloth_edge_count),
        soft_(soft),
        x_(x),
        parts_(parts) {}

  void list_parts(double w) {
    push_against_e(-1, w);
    for (const std::int8_t end : {std::int8_t{0}, std::int8_t{1}}) {
      const double share = weights_.end_share(false, pair_.a, end);
      if (share != 0.0) push_against_e(end, -share * w);
    }
  }

 private:
  void push(std::int8_t end_c, std::int8_t end_e, double coefficient, double d_sq) {
    // An end that is not continued has no other part to merge with.
    if (end_c >= 0 && weights_.end_share(false, pair_.a, end_c) == 0.0) end_c = -1;
    const bool shared = end_e >= 0 && !soft_;
    parts_.push_back({.kind = soft_ ? kMollified : (shared ? kVertex : kEdge),
                      .ends = {end_c, shared ? std::int8_t{-1} : end_e},
                      .id = shared ? pair_.vertices[2 + end_e] : pair_.b,
                      .coefficient = coefficient,
                      .d_sq = d_sq});
  }

  /// Add the parts of c as a whole, or of its end, against e and the ends of e.
  void push_against_e(std::int8_t end_c, double coefficient) {
    Corners at = corner_;
    if (end_c >= 0) at[0] = at[1] = corner_[end_c];
    const ClosestPoints whole =
        end_c >= 0 ? closest_points(PairKind::kEdgeEdge, at) : nearest_points_;
    const bool at_0 = whole.c[3] == 0.0;
    const bool at_1 = whole.c[2] == 0.0;
    if (!at_0 && !at_1) {
      const std::int8_t nearest = end_c >= 0 ? end_c : end_of(whole.c[0], whole.c[1]);
      push(nearest, -1, coefficient, whole.d_sq);
    }
    for (const std::int8_t end : {std::int8_t{0}, std::int8_t{1}}) {
      const bool nearest = end == 0 ? at_0 : at_1;
      const double share = (nearest ? 1.0 : 0.0) - weights_.end_share(against_cloth_, pair_.b, end);
      if (share == 0.0) continue;
      if (end_c >= 0) {
        push(end_c, end, coefficient * share, (at[0] - corner_[2 + end]).squaredNorm());
        continue;
      }
      const NearEdge near = nearest_on_edge(mesh_, pair_.a, corner_[2 + end], x_);
      const bool inside = near.vertex < 0;
      push(inside ? std::int8_t{-1} : std::int8_t{near.vertex == pair_.vertices[1]}, end,
           coefficient * share, near.d_sq);
    }
  }

  const CollisionMesh& mesh_;
  const FeatureWeights& weights_;
  const Candidate& pair_;
  const ClosestPoints& nearest_points_;
  const Corners& corner_;
  bool against_cloth_;
  bool soft_;
  const double* x_;
  std::vector<Part>& parts_;
};

/// Term of edge c and the feature of a part.
Term edge_term(const CollisionMesh& mesh, Index c, const Part& part, double scale) {
  const auto& [i, j] = mesh.edges[c];
  Candidate pair{
      .kind = PairKind::kEdgeEdge, .vertices = {i, j, part.id, part.id}, .a = c, .b = -1};
  std::array<std::int8_t, 2> ends = part.ends;
  if (part.kind != kVertex) {
    pair.vertices[2] = mesh.edges[part.id][0];
    pair.vertices[3] = mesh.edges[part.id][1];
    pair.b = part.id;
  }
  if (part.kind != kMollified && ends[0] >= 0) {
    pair.vertices[0] = pair.vertices[1] = mesh.edges[c][ends[0]];
    pair.b = -1;
    ends[0] = -1;
  }
  return {.pair = pair, .coefficient = scale * part.coefficient, .d_sq = part.d_sq, .ends = ends};
}

}  // namespace

void add_point_terms(const CollisionMesh& mesh,
                     const FeatureWeights::Features& features,
                     std::span<const Candidate> group,
                     const double* x,
                     double range,
                     double scale,
                     MergeScratch& scratch,
                     std::vector<Term>& out) {
  const Index point = group.front().a;
  const Vec3 p = row(x, point);
  if (group.size() == 1 && features.counts[group.front().b] != 0) {
    const Candidate& pair = group.front();
    const auto& [self, i, j, k] = pair.vertices;
    if (const auto d_sq = far_inside(p, row(x, i), row(x, j), row(x, k), range)) {
      if (*d_sq < range * range) out.push_back({.pair = pair, .coefficient = scale, .d_sq = *d_sq});
      return;
    }
  }
  find_faces_and_edges(mesh, features, group, x, range, scratch);
  if (scratch.faces.empty()) return;
  // If no edge is within range, no vertex is, and only the interiors of faces remain.
  const bool is_inside = std::ranges::all_of(
      scratch.edges, [&](const NearEdge& e) { return e.d_sq > kClearly * range * range; });
  if (is_inside) {
    list_face_parts(mesh, features, p, x, scratch);
  } else {
    find_vertices(mesh, scratch);
    list_point_parts(mesh, features, p, x, scratch);
  }
  merge(scratch.parts, range);
  for (Part& part : scratch.parts) {
    move_to_plane(mesh, features, scratch.faces, p, x, part);
    out.push_back({.pair = point_pair(mesh, point, part),
                   .coefficient = scale * part.coefficient,
                   .d_sq = part.d_sq});
  }
}

void add_edge_terms(const CollisionMesh& mesh,
                    const FeatureWeights& weights,
                    std::span<const Candidate> group,
                    std::span<const double> edge_length_sq,
                    const double* x,
                    double range,
                    double scale,
                    MergeScratch& scratch,
                    std::vector<Term>& out) {
  const Index c = group.front().a;
  scratch.parts.clear();
  for (const Candidate& pair : group) {
    const Index e = pair.b;
    const double w = weight(mesh, weights, c, e);
    if (w == 0.0) continue;
    const auto& v = pair.vertices;
    const Corners corner{row(x, v[0]), row(x, v[1]), row(x, v[2]), row(x, v[3])};
    if (is_beyond(corner, range)) continue;
    const ClosestPoints nearest_points = closest_points(PairKind::kEdgeEdge, corner);
    // Then the ends are beyond range too, and all parts they would merge with, up to the rounding of
    // distances.
    if (nearest_points.d_sq > kClearly * range * range) continue;
    const bool is_round = mesh.is_round_edge(c) || mesh.is_round_edge(e);
    const bool soft =
        mollified(corner, mollifier_threshold(edge_length_sq[c], edge_length_sq[e], is_round));
    EdgePair(mesh, weights, pair, nearest_points, corner, soft, x, scratch.parts).list_parts(w);
  }
  merge(scratch.parts, range);
  for (const Part& part : scratch.parts) out.push_back(edge_term(mesh, c, part, scale));
}

void merge_shared_ends(std::vector<Term>& terms) {
  const auto begins_with_edge = [](const Term& t) {
    return t.pair.kind != PairKind::kEdgeEdge || t.pair.vertices[0] != t.pair.vertices[1];
  };
  const auto shared = std::ranges::stable_partition(terms, begins_with_edge).begin();
  std::stable_sort(shared, terms.end(),
                   [](const Term& p, const Term& q) { return p.pair.vertices < q.pair.vertices; });
  auto last = shared;
  for (auto term = shared; term != terms.end(); ++term) {
    if (last != shared && (last - 1)->pair.vertices == term->pair.vertices) {
      (last - 1)->coefficient += term->coefficient;
    } else {
      *last++ = *term;
    }
  }
  terms.erase(std::remove_if(shared, last, [](const Term& t) { return t.coefficient == 0.0; }),
              terms.end());
}

}  // namespace diffcloth::contact
