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

void check_rest_faces(const Topology& topology) {
  if (topology.rest_faces.size() != topology.faces.size()) {
    throw std::invalid_argument("topology: `rest_faces` must be as many as `faces`, " +
                                std::to_string(topology.faces.size()) + ", got " +
                                std::to_string(topology.rest_faces.size()));
  }
  std::vector<Index> vertex(static_cast<std::size_t>(topology.rest_vertex_count), -1);
  for (std::size_t f = 0; f < topology.rest_faces.size(); ++f) {
    for (int p = 0; p < 3; ++p) {
      const Index r = topology.rest_faces[f][p];
      if (r < 0 || r >= topology.rest_vertex_count) {
        throw std::invalid_argument("topology: `rest_faces` must be in 0 .. " +
                                    std::to_string(topology.rest_vertex_count - 1) + ", got " +
                                    std::to_string(r) + " in face " + std::to_string(f));
      }
      const Index v = topology.faces[f][p];
      if (vertex[r] >= 0 && vertex[r] != v) {
        throw std::invalid_argument("topology: rest vertex " + std::to_string(r) +
                                    " must belong to one vertex, got " + std::to_string(vertex[r]) +
                                    " and " + std::to_string(v));
      }
      vertex[r] = v;
    }
  }
}

/// The ends of a side among the rest vertices, in the order of its edge.
std::array<Index, 2> rest_ends(const Topology& topology, const HalfEdge& side) {
  const Index p = (side.corner + 1) % 3, q = (side.corner + 2) % 3;
  const std::array<Index, 3>& rest = topology.rest_faces[side.face];
  const bool in_order = topology.faces[side.face][p] == side.edge[0];
  return in_order ? std::array{rest[p], rest[q]} : std::array{rest[q], rest[p]};
}

}  // namespace

Topology::Topology(Index vertex_count,
                   std::vector<std::array<Index, 3>> faces,
                   Index rest_vertex_count,
                   std::vector<std::array<Index, 3>> rest_faces)
    : vertex_count(vertex_count),
      faces(std::move(faces)),
      rest_vertex_count(rest_vertex_count),
      rest_faces(std::move(rest_faces)) {
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
  check_rest_faces(*this);
  std::ranges::stable_sort(sides, {}, &HalfEdge::edge);

  face_edges.resize(this->faces.size());
  for (const HalfEdge& side : sides) {
    if (edges.empty() || edges.back() != side.edge) {
      edges.push_back(side.edge);
      edge_faces.push_back({side.face, -1});
      const std::array<Index, 2> ends = rest_ends(*this, side);
      rest_edges.push_back({.first = ends, .last = ends});
    } else if (edge_faces.back()[1] < 0) {
      edge_faces.back()[1] = side.face;
      rest_edges.back().last = rest_ends(*this, side);
    } else {
      throw std::invalid_argument("topology: edge (" + std::to_string(side.edge[0]) + ", " +
                                  std::to_string(side.edge[1]) + ") must have at most two faces");
    }
    face_edges[side.face][side.corner] = static_cast<Index>(edges.size()) - 1;
  }
}

}  // namespace diffcloth::mesh
