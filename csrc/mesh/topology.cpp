#include "mesh/topology.h"

#include <algorithm>
#include <stdexcept>
#include <string>
#include <utility>

namespace diffcloth::mesh {
namespace {

/// One side of a face, to be sorted into edges.
struct HalfEdge {
  std::array<Index, 2> edge;
  Index face;
  Index corner;
};

void check_face(const std::array<Index, 3>& face, std::size_t f, Index vertex_count) {
  for (const Index v : face) {
    if (v < 0 || v >= vertex_count) {
      throw std::invalid_argument("topology: `faces` must be in 0 .. " +
                                  std::to_string(vertex_count - 1) + ", got " + std::to_string(v) +
                                  " in face " + std::to_string(f));
    }
  }
  if (face[0] == face[1] || face[1] == face[2] || face[2] == face[0]) {
    throw std::invalid_argument("topology: `faces` must have three different corners, face " +
                                std::to_string(f) + " repeats one");
  }
}

}  // namespace

Topology::Topology(Index vertex_count, std::vector<std::array<Index, 3>> faces)
    : vertex_count(vertex_count), faces(std::move(faces)) {
  std::vector<HalfEdge> sides;
  sides.reserve(3 * this->faces.size());
  for (std::size_t f = 0; f < this->faces.size(); ++f) {
    const std::array<Index, 3>& face = this->faces[f];
    check_face(face, f, vertex_count);
    for (Index p = 0; p < 3; ++p) {
      const auto [v0, v1] = std::minmax(face[(p + 1) % 3], face[(p + 2) % 3]);
      sides.push_back({.edge = {v0, v1}, .face = static_cast<Index>(f), .corner = p});
    }
  }
  std::ranges::stable_sort(sides, {}, &HalfEdge::edge);

  face_edges.resize(this->faces.size());
  for (const HalfEdge& side : sides) {
    if (edges.empty() || edges.back() != side.edge) {
      edges.push_back(side.edge);
      edge_faces.push_back({side.face, -1});
    } else if (edge_faces.back()[1] < 0) {
      edge_faces.back()[1] = side.face;
    } else {
      throw std::invalid_argument("topology: edge (" + std::to_string(side.edge[0]) + ", " +
                                  std::to_string(side.edge[1]) + ") must have at most two faces");
    }
    face_edges[side.face][side.corner] = static_cast<Index>(edges.size()) - 1;
  }
}

}  // namespace diffcloth::mesh
