#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "mesh/curvature_fit.h"
#include "mesh/fit_operator.h"
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
  const auto first_end = static_cast<Index>(patch.vertices.size());
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
  stencils.fit_points.insert(stencils.fit_points.end(), patch.vertices.begin(),
                             patch.vertices.end());
  stencils.unfold_edge.insert(stencils.unfold_edge.end(), patch.unfold_edge.begin(),
                              patch.unfold_edge.end());
  stencils.fit_start.push_back(static_cast<Index>(stencils.fit_points.size()));
  stencils.faces.push_back(faces);
  stencils.model.push_back(model);
}

/// Largest weight of the sum of two outward derivatives, relative to that in either of them, below
/// which two quadratics agree across their side. Lower values change no mode of a plate in the
/// fourth digit.
constexpr double kAgreement = 0.1;

/// The derivative across a side as one of its patches sees it.
struct Outward {
  std::span<const Index> points;
  SideWeights weights;
};

Outward outward(const BendingStencils& stencils, Index e, Index corner, const double* X) {
  const Chart local = element_chart(stencils, e, X);
  return {.points = stencils.fit(e),
          .weights =
              side_weights(side(base_parameters(local), corner), fit_operator(stencils, e, local))};
}

bool agree(const Outward& s0, const Outward& s1) {
  double largest = 0.0;
  for (std::size_t i = 0; i < s0.points.size(); ++i) {
    double sum = s0.weights(i);
    for (std::size_t j = 0; j < s1.points.size(); ++j) {
      if (s1.points[j] == s0.points[i]) sum += s1.weights(j);
    }
    largest = std::max(largest, std::abs(sum));
  }
  for (std::size_t j = 0; j < s1.points.size(); ++j) {
    if (std::ranges::find(s0.points, s1.points[j]) == s0.points.end()) {
      largest = std::max(largest, std::abs(s1.weights(j)));
    }
  }
  // Of both, so that the order of the faces does not matter.
  const double scale = std::max(s0.weights.cwiseAbs().maxCoeff(), s1.weights.cwiseAbs().maxCoeff());
  return largest < kAgreement * scale;
}

Index corner_opposite(const Topology& topology, Index face, Index edge) {
  const std::array<Index, 3>& edges = topology.face_edges[face];
  return static_cast<Index>(std::ranges::find(edges, edge) - edges.begin());
}

void find_kinks(const Topology& topology, const double* X, BendingStencils& stencils) {
  std::vector<Index> patch_of_face(topology.faces.size(), -1);
  for (Index e = 0; e < stencils.size(); ++e) {
    if (stencils.model[e] == BendingModel::kPatch) patch_of_face[stencils.faces[e][0]] = e;
  }
  for (Index edge = 0; edge < static_cast<Index>(topology.edges.size()); ++edge) {
    const auto [f0, f1] = topology.edge_faces[edge];
    if (f1 < 0 || patch_of_face[f0] < 0 || patch_of_face[f1] < 0) continue;
    const Index e0 = patch_of_face[f0], e1 = patch_of_face[f1];
    const Index p0 = corner_opposite(topology, f0, edge);
    const Index p1 = corner_opposite(topology, f1, edge);
    if (agree(outward(stencils, e0, p0, X), outward(stencils, e1, p1, X))) continue;
    stencils.kinks.push_back({.element = e0, .corner = p0, .other = e1, .other_corner = p1});
    stencils.kinks.push_back({.element = e1, .corner = p1, .other = e0, .other_corner = p0});
  }
}

/// Each element couples the points of its own quadratic and of those across its kinks.
void gather_vertices(BendingStencils& stencils) {
  std::vector<std::vector<Index>> elements(stencils.size());
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::span<const Index> points = stencils.fit(e);
    elements[e].assign(points.begin(), points.end());
  }
  for (const Kink& kink : stencils.kinks) {
    std::vector<Index>& element = elements[kink.element];
    for (const Index v : stencils.fit(kink.other)) {
      if (std::ranges::find(element, v) == element.end()) element.push_back(v);
    }
  }
  for (const std::vector<Index>& element : elements) {
    stencils.vertices.insert(stencils.vertices.end(), element.begin(), element.end());
    stencils.start.push_back(static_cast<Index>(stencils.vertices.size()));
  }
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
  find_kinks(topology, X, stencils);
  gather_vertices(stencils);
  return stencils;
}

}  // namespace diffcloth::mesh
