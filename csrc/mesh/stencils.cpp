#include <algorithm>
#include <stdexcept>

#include "mesh/curvature_fit.h"
#include "mesh/local_chart.h"
#include "mesh/rest_shape.h"

namespace diffcloth::mesh {
namespace {

/// A patch while it grows: vertices and the local edges that the extra ones are unfolded about.
struct Patch {
  Index face = -1;
  std::vector<Index> vertices;
  std::vector<std::array<Index, 2>> unfold_edge;
  std::vector<Index> reached_face;  ///< the face that brought each vertex

  explicit Patch(const Topology& topology, Index f)
      : face(f),
        vertices(topology.faces[f].begin(), topology.faces[f].end()),
        unfold_edge(3, {-1, -1}),
        reached_face(3, f) {}

  bool contains(Index v) const { return std::ranges::find(vertices, v) != vertices.end(); }
};

Index other_face(const Topology& topology, Index edge, Index face) {
  const auto [f0, f1] = topology.edge_faces[edge];
  return f0 == face ? f1 : f0;
}

/// The edge of `face` between two of its vertices, and the place of the third.
struct Across {
  Index edge;
  Index opposite;
};
Across across(const Topology& topology, Index face, Index v0, Index v1) {
  for (Index p = 0; p < 3; ++p) {
    const Index v = topology.faces[face][p];
    if (v != v0 && v != v1) return {.edge = topology.face_edges[face][p], .opposite = v};
  }
  throw std::logic_error("stencils: an edge is not on its face");
}

/// Add the vertex beyond local edge a -> b of `face`, if there is one and it is new.
void extend(const Topology& topology, Index face, Index a, Index b, Patch& patch) {
  const Index v0 = patch.vertices[a];
  const Index v1 = patch.vertices[b];
  const Index beyond = other_face(topology, across(topology, face, v0, v1).edge, face);
  if (beyond < 0) return;
  const Index v = across(topology, beyond, v0, v1).opposite;
  if (patch.contains(v)) return;
  patch.vertices.push_back(v);
  patch.unfold_edge.push_back({a, b});
  patch.reached_face.push_back(beyond);
}

void add_first_ring(const Topology& topology, Patch& patch) {
  for (Index p = 0; p < 3; ++p) extend(topology, patch.face, (p + 1) % 3, (p + 2) % 3, patch);
}

/// The vertices beyond the two other edges of each neighbor that brought a vertex.
void add_second_ring(const Topology& topology, Patch& patch) {
  const Index first_end = static_cast<Index>(patch.vertices.size());
  for (Index j = 3; j < first_end; ++j) {
    const auto [a, b] = patch.unfold_edge[j];  // the neighbor is (b, a, j), counterclockwise
    extend(topology, patch.reached_face[j], a, j, patch);
    extend(topology, patch.reached_face[j], j, b, patch);
  }
}

bool well_posed(const Patch& patch, const double* X) {
  if (patch.vertices.size() < 6) return false;
  return smallest_singular_value(fit_matrix(chart(patch.vertices, patch.unfold_edge, X))) >=
         kWellPosed;
}

void append(const Patch& patch,
            std::array<Index, 2> faces,
            BendingModel model,
            BendingStencils& stencils) {
  stencils.vertices.insert(stencils.vertices.end(), patch.vertices.begin(), patch.vertices.end());
  stencils.unfold_edge.insert(
      stencils.unfold_edge.end(), patch.unfold_edge.begin(), patch.unfold_edge.end());
  stencils.start.push_back(static_cast<Index>(stencils.vertices.size()));
  stencils.faces.push_back(faces);
  stencils.model.push_back(model);
}

}  // namespace

BendingStencils choose_stencils(const Topology& topology,
                                const double* X,
                                std::span<const BendingModel> face_model) {
  BendingStencils stencils;
  for (Index f = 0; f < static_cast<Index>(topology.faces.size()); ++f) {
    if (face_model[f] != BendingModel::kPatch) continue;
    Patch patch(topology, f);
    add_first_ring(topology, patch);
    if (patch.vertices.size() == 3) continue;
    if (!well_posed(patch, X)) add_second_ring(topology, patch);
    append(patch, {f, -1}, BendingModel::kPatch, stencils);
  }
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    const auto [f0, f1] = topology.edge_faces[e];
    if (f1 < 0) continue;
    if (face_model[f0] != BendingModel::kHinge || face_model[f1] != BendingModel::kHinge) continue;
    Patch patch(topology, f0);
    for (Index p = 0; p < 3; ++p) {
      if (topology.face_edges[f0][p] == static_cast<Index>(e)) {
        extend(topology, f0, (p + 1) % 3, (p + 2) % 3, patch);
      }
    }
    // Two faces on the same three vertices have no hinge.
    if (patch.vertices.size() == 4) append(patch, {f0, f1}, BendingModel::kHinge, stencils);
  }
  return stencils;
}

}  // namespace diffcloth::mesh
