#include "contact/broad_phase.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace diffcloth::contact {
namespace {

bool share_vertex(const std::array<Index, 2>& a, const std::array<Index, 2>& b) {
  return a[0] == b[0] || a[0] == b[1] || a[1] == b[0] || a[1] == b[1];
}

bool contains(const std::array<Index, 3>& face, Index vertex) {
  return face[0] == vertex || face[1] == vertex || face[2] == vertex;
}

/// Six times the signed volume of a tetrahedron.
double volume(const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d) {
  return (b - a).dot((c - a).cross(d - a));
}

bool pierces(const Vec3& e0, const Vec3& e1, const Vec3& t0, const Vec3& t1, const Vec3& t2) {
  if (!(volume(e0, t0, t1, t2) * volume(e1, t0, t1, t2) < 0.0)) return false;
  const double v0 = volume(e0, e1, t0, t1);
  const double v1 = volume(e0, e1, t1, t2);
  const double v2 = volume(e0, e1, t2, t0);
  return (v0 > 0.0 && v1 > 0.0 && v2 > 0.0) || (v0 < 0.0 && v1 < 0.0 && v2 < 0.0);
}

}  // namespace

Index BroadPhase::first(Group group) const {
  switch (group) {
    case kBodyVertices:
      return mesh_.cloth_vertex_count;
    case kBodyEdges:
      return mesh_.cloth_edge_count;
    case kBodyFaces:
      return mesh_.cloth_face_count;
    case kClothVertices:
    case kClothEdges:
    case kClothFaces:
      return 0;
  }
  return 0;
}

Index BroadPhase::count(Group group) const {
  switch (group) {
    case kClothVertices:
      return mesh_.cloth_vertex_count;
    case kClothEdges:
      return mesh_.cloth_edge_count;
    case kClothFaces:
      return mesh_.cloth_face_count;
    case kBodyVertices:
      return mesh_.vertex_count - mesh_.cloth_vertex_count;
    case kBodyEdges:
      return static_cast<Index>(mesh_.edges.size()) - mesh_.cloth_edge_count;
    case kBodyFaces:
      return static_cast<Index>(mesh_.faces.size()) - mesh_.cloth_face_count;
  }
  return 0;
}

/// Boxes of a group's primitives from those of their vertices, then of its tree.
template <class VertexBox>
void BroadPhase::refit(Group group, const VertexBox& box, Scratch& scratch) const {
  scratch.primitives.resize(static_cast<std::size_t>(count(group)));
  const Index begin = first(group);
  for (Index k = 0; k < count(group); ++k) {
    Box& target = scratch.primitives[k];
    if (group == kClothVertices || group == kBodyVertices) {
      target = box(begin + k);
    } else if (group == kClothEdges || group == kBodyEdges) {
      const auto& e = mesh_.edges[begin + k];
      target = box(e[0]);
      target.include(box(e[1]));
    } else {
      const auto& f = mesh_.faces[begin + k];
      target = box(f[0]);
      target.include(box(f[1]));
      target.include(box(f[2]));
    }
  }
  trees_[group].refit(scratch.primitives, scratch.boxes[group]);
}

template <class VertexBox>
void BroadPhase::refit_all(const VertexBox& box, Scratch& scratch) const {
  for (const Group group :
       {kClothVertices, kClothEdges, kClothFaces, kBodyVertices, kBodyEdges, kBodyFaces}) {
    refit(group, box, scratch);
  }
}

template <class Visit>
void BroadPhase::overlaps(Group a, Group b, Scratch& scratch, const Visit& visit) const {
  const Index first_a = first(a);
  const Index first_b = first(b);
  BoxTree::overlaps(trees_[a],
                    scratch.boxes[a],
                    trees_[b],
                    scratch.boxes[b],
                    scratch.stack,
                    [&](Index p, Index q) { visit(first_a + p, first_b + q); });
}

BroadPhase::BroadPhase(const CollisionMesh& mesh, const double* x) : mesh_(mesh) {
  Scratch scratch;
  const auto point = [&](Index i) {
    const Vec3 p = row(x, i);
    return Box{.lower = p, .upper = p};
  };
  for (const Group group :
       {kClothVertices, kClothEdges, kClothFaces, kBodyVertices, kBodyEdges, kBodyFaces}) {
    refit(group, point, scratch);
    std::vector<Vec3> centers;
    for (const Box& box : scratch.primitives) centers.push_back(0.5 * (box.lower + box.upper));
    trees_[group] = BoxTree(centers);
  }
}

void BroadPhase::find(const double* x_t0,
                      const double* x_t1,
                      double radius,
                      Scratch& scratch,
                      std::vector<Candidate>& out) const {
  out.clear();
  refit_all(
      [&](Index i) {
        const Vec3 a = row(x_t0, i);
        const Vec3 b = row(x_t1, i);
        // Outward by more than the rounding of the sums below and of the distances compared later.
        const double inflation =
            0.5 * radius +
            1e-12 * std::max(a.cwiseAbs().maxCoeff(), b.cwiseAbs().maxCoeff());
        return Box{.lower = (a.cwiseMin(b).array() - inflation).matrix(),
                   .upper = (a.cwiseMax(b).array() + inflation).matrix()};
      },
      scratch);

  const auto point_triangle = [&](Index v, Index f) {
    const auto& face = mesh_.faces[f];
    if (!mesh_.may_touch(mesh_.vertex_surface[v], mesh_.face_surface[f]) || contains(face, v)) {
      return;
    }
    out.push_back({.kind = PairKind::kPointTriangle,
                   .a = v,
                   .b = f,
                   .vertices = {v, face[0], face[1], face[2]}});
  };
  const auto edge_edge = [&](Index a, Index b) {
    const auto& e = mesh_.edges[a];
    const auto& f = mesh_.edges[b];
    if (!mesh_.may_touch(mesh_.edge_surface[a], mesh_.edge_surface[b]) || share_vertex(e, f)) {
      return;
    }
    out.push_back(
        {.kind = PairKind::kEdgeEdge, .a = a, .b = b, .vertices = {e[0], e[1], f[0], f[1]}});
  };
  if (mesh_.self_contact || mesh_.cloth_count > 1) {
    overlaps(kClothVertices, kClothFaces, scratch, point_triangle);
    trees_[kClothEdges].self_overlaps(scratch.boxes[kClothEdges], scratch.stack, edge_edge);
  }
  overlaps(kClothVertices, kBodyFaces, scratch, point_triangle);
  overlaps(kBodyVertices, kClothFaces, scratch, point_triangle);
  overlaps(kClothEdges, kBodyEdges, scratch, edge_edge);
  std::ranges::sort(out);
}

std::optional<std::pair<Index, Index>> BroadPhase::find_intersection(const double* x,
                                                                     Scratch& scratch) const {
  refit_all(
      [&](Index i) {
        const Vec3 p = row(x, i);
        return Box{.lower = p, .upper = p};
      },
      scratch);
  std::optional<std::pair<Index, Index>> lowest;
  const auto test = [&](Index e, Index f) {
    const auto& edge = mesh_.edges[e];
    const auto& face = mesh_.faces[f];
    if (!mesh_.may_touch(mesh_.edge_surface[e], mesh_.face_surface[f]) ||
        contains(face, edge[0]) || contains(face, edge[1])) {
      return;
    }
    if (lowest && std::pair(e, f) >= *lowest) return;
    if (pierces(row(x, edge[0]),
                row(x, edge[1]),
                row(x, face[0]),
                row(x, face[1]),
                row(x, face[2]))) {
      lowest = {e, f};
    }
  };
  if (mesh_.self_contact || mesh_.cloth_count > 1) {
    overlaps(kClothEdges, kClothFaces, scratch, test);
  }
  overlaps(kClothEdges, kBodyFaces, scratch, test);
  overlaps(kBodyEdges, kClothFaces, scratch, test);
  return lowest;
}

double smallest_nonadjacent_distance(const CollisionMesh& mesh, const double* x) {
  const CollisionMesh cloths(
      mesh.cloth_vertex_count,
      mesh.cloth_vertex_count,
      mesh.cloth_count,
      {mesh.faces.begin(), mesh.faces.begin() + mesh.cloth_face_count},
      {mesh.vertex_surface.begin(), mesh.vertex_surface.begin() + mesh.cloth_vertex_count},
      true);
  const BroadPhase broad_phase(cloths, x);
  double shortest = std::numeric_limits<double>::infinity();
  for (const auto& e : cloths.edges) {
    shortest = std::min(shortest, (row(x, e[0]) - row(x, e[1])).norm());
  }
  Vec3 lower = row(x, 0);
  Vec3 upper = lower;
  for (Index i = 0; i < cloths.vertex_count; ++i) {
    lower = lower.cwiseMin(row(x, i));
    upper = upper.cwiseMax(row(x, i));
  }

  // A pair closer than the search radius is in the list, so the first radius that exceeds the
  // smallest distance found settles it.
  BroadPhase::Scratch scratch;
  std::vector<Candidate> pairs;
  const double largest_radius = 2.0 * (upper - lower).norm() + shortest;
  for (double radius = 0.5 * shortest;; radius *= 2.0) {
    broad_phase.find(x, x, radius, scratch, pairs);
    double smallest = std::numeric_limits<double>::infinity();
    for (const Candidate& pair : pairs) {
      const auto& v = pair.vertices;
      if (cloths.vertex_surface[v[0]] != cloths.vertex_surface[v[3]]) continue;
      smallest = std::min(
          smallest,
          distance_sq(pair.kind, {row(x, v[0]), row(x, v[1]), row(x, v[2]), row(x, v[3])}));
    }
    smallest = std::sqrt(smallest);
    if (smallest <= radius || radius > largest_radius) return smallest;
  }
}

}  // namespace diffcloth::contact
