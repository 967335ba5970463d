#include "contact/collision_mesh.h"

#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

namespace diffcloth::contact {
namespace {

void check(const CollisionMesh& mesh) {
  if (mesh.radius.size() != static_cast<std::size_t>(mesh.surface_count())) {
    throw std::invalid_argument("collision mesh: `radius` must have one value a surface");
  }
  for (Index s = 0; s < mesh.surface_count(); ++s) {
    if (!(mesh.radius[s] >= 0.0) || (s < mesh.cloth_count && mesh.radius[s] > 0.0)) {
      throw std::invalid_argument(
          "collision mesh: `radius` must be 0 of cloths and at least 0 of bodies, got " +
          std::to_string(mesh.radius[s]) + " at surface " + std::to_string(s));
    }
  }
  for (Index i = 0; i < mesh.vertex_count; ++i) {
    if (mesh.vertex_surface[i] < (i == 0 ? 0 : mesh.vertex_surface[i - 1]) ||
        mesh.vertex_surface[i] >= mesh.surface_count()) {
      throw std::invalid_argument(
          "collision mesh: `vertex_surface` must ascend from 0 and stay below " +
          std::to_string(mesh.surface_count()) + ", got " + std::to_string(mesh.vertex_surface[i]) +
          " at vertex " + std::to_string(i));
    }
  }
  Index previous = 0;
  for (std::size_t f = 0; f < mesh.faces.size(); ++f) {
    const auto& [i, j, k] = mesh.faces[f];
    const auto refuse = [&](const std::string& rule) {
      throw std::invalid_argument("collision mesh: `faces` must " + rule + ", got (" +
                                  std::to_string(i) + ", " + std::to_string(j) + ", " +
                                  std::to_string(k) + ") at face " + std::to_string(f));
    };
    for (const Index v : mesh.faces[f]) {
      if (v < 0 || v >= mesh.vertex_count) refuse("refer to vertices of the mesh");
    }
    const Index surface = mesh.vertex_surface[i];
    if (mesh.vertex_surface[j] != surface || mesh.vertex_surface[k] != surface) {
      refuse("lie on one surface");
    }
    if (mesh.is_round(surface)) {
      if (j != k) refuse("be a point or a segment where their surface is round");
      if (surface == previous && f > 0 && mesh.vertex_surface[mesh.faces[f - 1][0]] == surface) {
        refuse("be one where their surface is round");
      }
    } else if (i == j || j == k || k == i) {
      refuse("have three different corners");
    }
    if (surface < previous) refuse("be grouped by surface in ascending order");
    previous = surface;
  }
}

/// Side of a face; sorted to find the unique edges.
struct HalfEdge {
  Index surface;
  CollisionMesh::Edge edge;
  Index face;  ///< -1: segment of a skeleton, whose face has no area
  int side;    ///< The side joins the corners side and side + 1.
};

std::vector<HalfEdge> sorted_half_edges(const CollisionMesh& mesh) {
  std::vector<HalfEdge> half_edges;
  half_edges.reserve(3 * mesh.faces.size());
  for (std::size_t f = 0; f < mesh.faces.size(); ++f) {
    if (mesh.is_round(mesh.face_surface[f])) {
      const auto [v0, v1] = std::minmax(mesh.faces[f][0], mesh.faces[f][1]);
      if (v0 == v1) continue;
      half_edges.push_back(
          {.surface = mesh.face_surface[f], .edge = {v0, v1}, .face = -1, .side = 0});
      continue;
    }
    for (int k = 0; k < 3; ++k) {
      const auto [v0, v1] = std::minmax(mesh.faces[f][k], mesh.faces[f][(k + 1) % 3]);
      half_edges.push_back({.surface = mesh.face_surface[f],
                            .edge = {v0, v1},
                            .face = static_cast<Index>(f),
                            .side = k});
    }
  }
  std::sort(half_edges.begin(), half_edges.end(), [](const HalfEdge& p, const HalfEdge& q) {
    return std::tie(p.surface, p.edge, p.face) < std::tie(q.surface, q.edge, q.face);
  });
  return half_edges;
}

}  // namespace

CollisionMesh::CollisionMesh(std::vector<Face> faces_in,
                             std::vector<Index> vertex_surface_in,
                             Index cloth_count_in,
                             SurfacePairs touching_in,
                             std::vector<double> radius_in)
    : vertex_count(static_cast<Index>(vertex_surface_in.size())),
      cloth_count(cloth_count_in),
      faces(std::move(faces_in)),
      vertex_surface(std::move(vertex_surface_in)),
      radius(std::move(radius_in)),
      touching(std::move(touching_in)) {
  if (radius.empty()) radius.assign(static_cast<std::size_t>(surface_count()), 0.0);
  check(*this);
  for (const Index surface : vertex_surface) cloth_vertex_count += surface < cloth_count;
  face_surface.reserve(faces.size());
  for (const Face& face : faces) {
    face_surface.push_back(vertex_surface[face[0]]);
    cloth_face_count += face_surface.back() < cloth_count;
  }
  is_point_.assign(static_cast<std::size_t>(surface_count()), 0);
  for (std::size_t f = 0; f < faces.size(); ++f) {
    is_point_[face_surface[f]] = is_round(face_surface[f]) && faces[f][0] == faces[f][1];
  }
  face_edges.assign(faces.size(), {-1, -1, -1});
  for (const HalfEdge& half_edge : sorted_half_edges(*this)) {
    if (edges.empty() || edges.back() != half_edge.edge) {
      edges.push_back(half_edge.edge);
      edge_surface.push_back(half_edge.surface);
      edge_faces.push_back({half_edge.face, -1});
      cloth_edge_count += half_edge.surface < cloth_count;
    } else if (edge_faces.back()[1] < 0) {
      edge_faces.back()[1] = half_edge.face;
    }
    if (half_edge.face < 0) continue;
    face_edges[half_edge.face][half_edge.side] = static_cast<Index>(edges.size()) - 1;
  }
}

}  // namespace diffcloth::contact
