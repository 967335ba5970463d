#include "contact/feature_areas.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <utility>

#include <Eigen/Geometry>

#include "common/disjoint_sets.h"

namespace diffcloth::contact {
namespace {

/// Sine of the largest angle at which two edges still form one line: the tolerance of flatness.
constexpr double kStraight = 1e-4;

/// Facet of every face, identified by one of its faces.
std::vector<Index> find_facets(const CollisionMesh& mesh, const Bulge& bulge) {
  DisjointSets sets(mesh.faces.size());
  for (std::size_t e = mesh.cloth_edge_count; e < mesh.edges.size(); ++e) {
    if (bulge.flat[e] != 0) sets.unite(mesh.edge_faces[e][0], mesh.edge_faces[e][1]);
  }
  std::vector<Index> facet(mesh.faces.size());
  for (std::size_t f = 0; f < facet.size(); ++f) facet[f] = sets.find(static_cast<Index>(f));
  return facet;
}

/// Facets at every edge, the lower first; -1 if missing.
std::vector<std::array<Index, 2>> facets_of_edges(const CollisionMesh& mesh,
                                                  const std::vector<Index>& facet) {
  std::vector<std::array<Index, 2>> result;
  for (const auto& [f, g] : mesh.edge_faces) {
    if (f < 0) {
      result.push_back({-1, -1});
      continue;
    }
    const Index other = g < 0 ? -1 : facet[g];
    result.push_back({std::min(facet[f], other), std::max(facet[f], other)});
  }
  return result;
}

/// Ridge of every edge of a body, identified by one of its edges.
std::vector<Index> find_ridges(const CollisionMesh& mesh,
                               const double* X,
                               const Bulge& bulge,
                               const std::vector<std::array<Index, 2>>& facets) {
  std::vector<std::vector<Index>> at_vertex(mesh.vertex_count);
  for (auto e = mesh.cloth_edge_count; e < static_cast<Index>(mesh.edges.size()); ++e) {
    if (bulge.flat[e] != 0) continue;
    for (const Index v : mesh.edges[e]) at_vertex[v].push_back(e);
  }
  const auto away = [&](Index e, Index v) -> Vec3 {
    const auto& [i, j] = mesh.edges[e];
    return (row(X, i == v ? j : i) - row(X, v)).normalized();
  };
  DisjointSets sets(mesh.edges.size());
  for (Index v = mesh.cloth_vertex_count; v < mesh.vertex_count; ++v) {
    for (const Index p : at_vertex[v]) {
      for (const Index q : at_vertex[v]) {
        if (q <= p || facets[p] != facets[q]) continue;
        const Vec3 along = away(p, v);
        const Vec3 on = away(q, v);
        if (along.dot(on) < 0.0 && along.cross(on).norm() < kStraight) sets.unite(p, q);
      }
    }
  }
  std::vector<Index> ridge(mesh.edges.size());
  for (std::size_t e = 0; e < ridge.size(); ++e) ridge[e] = sets.find(static_cast<Index>(e));
  return ridge;
}

double angle_at(const double* X, const CollisionMesh::Face& face, int k) {
  const Vec3 e0 = row(X, face[(k + 1) % 3]) - row(X, face[k]);
  const Vec3 e1 = row(X, face[(k + 2) % 3]) - row(X, face[k]);
  return std::atan2(e0.cross(e1).norm(), e0.dot(e1));
}

}  // namespace

double round_area(const CollisionMesh& mesh, const double* X, std::size_t face) {
  const auto& [i, j, k] = mesh.faces[face];
  const double r = mesh.radius[mesh.face_surface[face]];
  return 2.0 * std::numbers::pi * r * (2.0 * r + (row(X, j) - row(X, i)).norm());
}

FeatureAreas feature_areas(const CollisionMesh& mesh, const double* X, const Bulge& bulge) {
  FeatureAreas result{.vertex = std::vector<double>(mesh.vertex_count, 0.0),
                      .edge = std::vector<double>(mesh.edges.size(), 0.0),
                      .surface = std::vector<double>(mesh.surface_count(), 0.0)};
  const std::vector<Index> facet = find_facets(mesh, bulge);
  std::vector<double> area(mesh.faces.size(), 0.0);  // of facets, as the next two
  std::vector<double> angle(mesh.faces.size(), 0.0);
  std::vector<double> perimeter(mesh.faces.size(), 0.0);
  const auto for_each_corner = [&](auto&& visit) {
    for (std::size_t f = mesh.cloth_face_count; f < mesh.faces.size(); ++f) {
      if (mesh.is_round_face(static_cast<Index>(f))) continue;
      for (int k = 0; k < 3; ++k) {
        const Index v = mesh.faces[f][k];
        if (bulge.vertex[v] > 0.0) visit(facet[f], v, angle_at(X, mesh.faces[f], k));
      }
    }
  };
  for (std::size_t f = mesh.cloth_face_count; f < mesh.faces.size(); ++f) {
    const auto& [i, j, k] = mesh.faces[f];
    if (mesh.is_round_face(static_cast<Index>(f))) {
      constexpr double kShare = 1.0 / 6.0;
      const double whole = round_area(mesh, X, f);
      result.surface[mesh.face_surface[f]] += whole;
      for (const Index end : {i, j}) result.vertex[end] += 0.5 * kShare * whole;
      continue;
    }
    const Vec3 normal = (row(X, j) - row(X, i)).cross(row(X, k) - row(X, i));
    area[facet[f]] += 0.5 * normal.norm();
    result.surface[mesh.face_surface[f]] += 0.5 * normal.norm();
  }
  for_each_corner([&](Index of, Index, double alpha) { angle[of] += alpha; });
  for_each_corner([&](Index of, Index v, double alpha) {
    if (angle[of] > 0.0) result.vertex[v] += area[of] * alpha / angle[of];
  });

  const std::vector<std::array<Index, 2>> facets = facets_of_edges(mesh, facet);
  const std::vector<Index> ridge = find_ridges(mesh, X, bulge, facets);
  std::vector<double> length(mesh.edges.size(), 0.0);  // of ridges
  for (std::size_t e = mesh.cloth_edge_count; e < mesh.edges.size(); ++e) {
    if (bulge.flat[e] != 0) continue;
    const double l = (row(X, mesh.edges[e][1]) - row(X, mesh.edges[e][0])).norm();
    length[ridge[e]] += l;
    for (const Index of : facets[e]) {
      if (of >= 0) perimeter[of] += l;
    }
  }
  for (std::size_t e = mesh.cloth_edge_count; e < mesh.edges.size(); ++e) {
    if (mesh.is_round_edge(static_cast<Index>(e))) {
      for (const Index end : mesh.edges[e]) result.edge[e] += result.vertex[end];
      continue;
    }
    if (bulge.edge[e] == 0.0) continue;
    for (const Index of : facets[e]) {
      if (of >= 0) result.edge[e] += area[of] * length[ridge[e]] / perimeter[of];
    }
  }
  return result;
}

}  // namespace diffcloth::contact
