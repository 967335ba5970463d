#include "contact/collision_mesh.h"

#include <algorithm>

namespace diffcloth::contact {

CollisionMesh::CollisionMesh(Index vertex_count_in,
                             Index cloth_vertex_count_in,
                             Index cloth_count_in,
                             std::vector<std::array<Index, 3>> faces_in,
                             std::vector<Index> vertex_surface_in,
                             bool self_contact_in)
    : vertex_count(vertex_count_in),
      cloth_vertex_count(cloth_vertex_count_in),
      cloth_count(cloth_count_in),
      faces(std::move(faces_in)),
      cloth_face_count(0),
      cloth_edge_count(0),
      vertex_surface(std::move(vertex_surface_in)),
      self_contact(self_contact_in) {
  struct Side {
    std::array<Index, 2> edge;
    Index face;
  };
  std::vector<Side> sides;
  sides.reserve(3 * faces.size());
  for (std::size_t f = 0; f < faces.size(); ++f) {
    for (int k = 0; k < 3; ++k) {
      const Index v = faces[f][k];
      const Index w = faces[f][(k + 1) % 3];
      sides.push_back({.edge = {std::min(v, w), std::max(v, w)}, .face = static_cast<Index>(f)});
    }
    face_surface.push_back(vertex_surface[faces[f][0]]);
    if (faces[f][0] < cloth_vertex_count) ++cloth_face_count;
  }
  std::ranges::stable_sort(sides, {}, &Side::edge);
  for (const Side& side : sides) {
    if (edges.empty() || edges.back() != side.edge) {
      edges.push_back(side.edge);
      edge_surface.push_back(vertex_surface[side.edge[0]]);
      edge_faces.emplace_back();
      if (side.edge[0] < cloth_vertex_count) ++cloth_edge_count;
    }
    edge_faces.back().push_back(side.face);
  }
}

}  // namespace diffcloth::contact
