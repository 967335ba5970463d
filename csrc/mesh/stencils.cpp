#include <algorithm>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <utility>

#include "mesh/curvature_fit.h"
#include "mesh/fit_operator.h"
#include "mesh/local_chart.h"
#include "mesh/quadratics.h"
#include "mesh/rest_shape.h"
#include "mesh/side_derivative.h"

namespace diffcloth::mesh {
namespace {

/// Smallest singular value with which six points determine a quadratic.
constexpr double kWellPosed = 0.15;

/// Two quadratics agree across their side if the largest weight of the sum of their outward derivatives,
/// relative to the largest weight in either of them, is below this value.
constexpr double kAgreement = 1e-3;

Index other_face(const Topology& topology, Index edge, Index face) {
  const auto [f0, f1] = topology.edge_faces[edge];
  return f0 == face ? f1 : f0;
}

Index corner_opposite(const Topology& topology, Index face, Index edge) {
  const std::array<Index, 3>& edges = topology.face_edges[face];
  return static_cast<Index>(std::ranges::find(edges, edge) - edges.begin());
}

/// Faces unfolded one after the other, and their vertices.
class Patch {
 public:
  Patch(const Topology& topology, Index face)
      : topology_(&topology),
        vertices_(topology.faces[face].begin(), topology.faces[face].end()),
        faces_{{.face = face, .corner = {0, 1, 2}}} {
    const std::array<Unfolding, 3> corners = base_points(topology.rest_faces[face]);
    unfoldings_.assign(corners.begin(), corners.end());
  }

  const std::vector<Index>& vertices() const { return vertices_; }
  const std::vector<Unfolding>& unfoldings() const { return unfoldings_; }

  Chart chart(const double* X) const { return mesh::chart(unfoldings_, X); }

  /// Add the face beyond the side opposite corner p of the base face, if there is one.
  void add_across(Index p) { add_beyond(0, topology_->face_edges[faces_[0].face][p]); }

  /// Add the faces across all sides.
  ///
  /// @returns  true if a vertex was added
  bool add_layer() {
    const std::size_t face_count = faces_.size(), vertex_count = vertices_.size();
    for (std::size_t i = 0; i < face_count; ++i) {
      const Index face = faces_[i].face;
      for (Index p = 0; p < 3; ++p) add_beyond(i, topology_->face_edges[face][p]);
    }
    return vertices_.size() > vertex_count;
  }

 private:
  struct Unfolded {
    Index face;
    std::array<Index, 3> corner;  ///< indices of the corners, counterclockwise in the plane
  };

  Index place(Index v) const {
    return static_cast<Index>(std::ranges::find(vertices_, v) - vertices_.begin());
  }

  void add_beyond(std::size_t i, Index edge) {
    const Index beyond = other_face(*topology_, edge, faces_[i].face);
    const auto is_beyond = [&](const Unfolded& other) { return other.face == beyond; };
    if (beyond < 0 || std::ranges::any_of(faces_, is_beyond)) return;
    const auto [v0, v1] = topology_->edges[edge];
    Index a = place(v0), b = place(v1);
    const std::array<Index, 3>& corner = faces_[i].corner;
    const auto at_a = std::ranges::find(corner, a) - corner.begin();
    if (corner[(at_a + 1) % 3] != b) std::swap(a, b);  // the face is to the left of a -> b
    const Index v = topology_->faces[beyond][corner_opposite(*topology_, beyond, edge)];
    const Index j = place(v);
    if (j == static_cast<Index>(vertices_.size())) {
      vertices_.push_back(v);
      const auto rest = [&](Index vertex) {
        const auto corner = std::ranges::find(topology_->faces[beyond], vertex);
        return topology_->rest_faces[beyond][corner - topology_->faces[beyond].begin()];
      };
      unfoldings_.push_back(
          {.edge = {a, b}, .rest = {rest(vertices_[a]), rest(vertices_[b]), rest(v)}});
    }
    faces_.push_back({.face = beyond, .corner = {b, a, j}});
  }

  const Topology* topology_;
  std::vector<Index> vertices_;
  std::vector<Unfolding> unfoldings_;
  std::vector<Unfolded> faces_;
};

void append_chart(const Patch& patch, BendingStencils& stencils) {
  stencils.chart_points.insert(stencils.chart_points.end(), patch.vertices().begin(),
                               patch.vertices().end());
  stencils.unfoldings.insert(stencils.unfoldings.end(), patch.unfoldings().begin(),
                             patch.unfoldings().end());
  stencils.chart_start.push_back(static_cast<Index>(stencils.chart_points.size()));
}

void append_element(const Patch& patch,
                    std::array<Index, 2> faces,
                    BendingModel model,
                    BendingStencils& stencils) {
  append_chart(patch, stencils);
  stencils.faces.push_back(faces);
  stencils.model.push_back(model);
}

/// A face that bends as a patch, and the quadratic of its six points if they determine it.
struct PatchFace {
  Index face;
  Patch patch;
  std::optional<Operator> quadratic;
  std::array<double, 3> base;

  PatchFace(const Topology& topology, Index f, const double* X) : face(f), patch(topology, f) {
    patch.add_layer();
    const Chart local = patch.chart(X);
    base = base_parameters(local);
    if (local.size == kMaxQuadratic &&
        singular_values(fit_matrix(local)).minCoeff() >= kWellPosed) {
      quadratic = patch_operator(local);
    }
  }
};

/// True if the quadratics of two faces have equal derivatives across the shared side.
bool agree(const PatchFace& f0, Index corner0, const PatchFace& f1, Index corner1) {
  if (!f0.quadratic || !f1.quadratic) return false;
  const SideWeights w0 = side_weights(side(f0.base, corner0), *f0.quadratic);
  const SideWeights w1 = side_weights(side(f1.base, corner1), *f1.quadratic);
  const std::vector<Index>&points0 = f0.patch.vertices(), &points1 = f1.patch.vertices();
  double largest = 0.0;
  for (std::size_t i = 0; i < points0.size(); ++i) {
    double sum = w0(static_cast<Index>(i));
    for (std::size_t j = 0; j < points1.size(); ++j) {
      if (points1[j] == points0[i]) sum += w1(static_cast<Index>(j));
    }
    largest = std::max(largest, std::abs(sum));
  }
  for (std::size_t j = 0; j < points1.size(); ++j) {
    if (std::ranges::find(points0, points1[j]) == points0.end()) {
      largest = std::max(largest, std::abs(w1(static_cast<Index>(j))));
    }
  }
  // The maximum over both makes the result independent of the order of the faces.
  return largest < kAgreement * std::max(w0.cwiseAbs().maxCoeff(), w1.cwiseAbs().maxCoeff());
}

/// The two faces of a side, and layers around them: one, or as many as needed for six points. A second
/// layer is added if the points do not determine the derivative well and the layer improves that.
Patch side_patch(const Topology& topology, Index face, Index corner, const double* X) {
  Patch first(topology, face);
  first.add_across(corner);
  int layers = 0;
  do {
    ++layers;
    if (!first.add_layer()) return first;
  } while (first.vertices().size() < 6);
  if (layers > 1) return first;
  const SideQuality quality = side_quality(side_stencil(first.chart(X), corner));
  if (quality.good()) return first;
  Patch second = first;
  if (!second.add_layer()) return first;
  const bool better = side_quality(side_stencil(second.chart(X), corner)).better_than(quality);
  return better ? second : first;
}

/// Vertices of an element, and their rest vertices in its charts.
class ElementPoints {
 public:
  void add(const BendingStencils& stencils, Index chart) {
    const std::span<const Index> points = stencils.points(chart);
    const std::span<const Unfolding> unfolding = stencils.unfolding(chart);
    for (Index j = 0; j < static_cast<Index>(points.size()); ++j) {
      const auto [a, b] = unfolding[j].edge;
      const std::array<Index, 3> local =
          j < 3 ? std::array<Index, 3>{0, 1, 2} : std::array{a, b, j};
      for (int p = 0; p < 3; ++p) add(points[local[p]], unfolding[j].rest[p]);
    }
  }

  const std::vector<Index>& vertices() const { return vertices_; }
  const std::vector<Index>& rest_vertices() const { return rest_vertices_; }
  /// True if a vertex has several rest vertices.
  bool sewn() const { return sewn_; }

 private:
  void add(Index vertex, Index rest_vertex) {
    const auto found = std::ranges::find(vertices_, vertex);
    if (found == vertices_.end()) {
      vertices_.push_back(vertex);
      rest_vertices_.push_back(rest_vertex);
    } else if (rest_vertices_[found - vertices_.begin()] != rest_vertex) {
      sewn_ = true;
    }
  }

  std::vector<Index> vertices_, rest_vertices_;
  bool sewn_ = false;
};

/// Collect the vertices of elements: the points of their own quadratic and of their fitted sides.
void gather_vertices(BendingStencils& stencils) {
  std::vector<ElementPoints> elements(stencils.size());
  for (Index e = 0; e < stencils.size(); ++e) {
    elements[e].add(stencils, e);
  }
  for_each_element_side(stencils, [&](const ElementSide& part) {
    elements[part.element].add(stencils, stencils.side_chart(part.side));
  });
  for (const ElementPoints& element : elements) {
    stencils.vertices.insert(stencils.vertices.end(), element.vertices().begin(),
                             element.vertices().end());
    stencils.rest_vertices.insert(stencils.rest_vertices.end(), element.rest_vertices().begin(),
                                  element.rest_vertices().end());
    stencils.sewn.push_back(element.sewn() ? 1 : 0);
    stencils.start.push_back(static_cast<Index>(stencils.vertices.size()));
  }
}

/// True if a patch has a single face and therefore no side about which to bend.
bool alone(const Patch& patch) { return patch.vertices().size() == 3; }

/// The patches, and the charts of their fitted sides.
std::vector<Patch> choose_patches(const Topology& topology,
                                  const double* X,
                                  std::span<const BendingModel> face_model,
                                  BendingStencils& stencils) {
  std::vector<PatchFace> patches;
  std::vector<Index> element(topology.faces.size(), -1);
  for (Index f = 0; f < static_cast<Index>(topology.faces.size()); ++f) {
    if (face_model[f] != BendingModel::kPatch) continue;
    PatchFace patch(topology, f, X);
    if (alone(patch.patch)) continue;
    element[f] = static_cast<Index>(patches.size());
    patches.push_back(std::move(patch));
  }
  std::vector<bool> takes_quadratic(patches.size(), false);
  std::vector<Patch> sides;
  for (Index edge = 0; edge < static_cast<Index>(topology.edges.size()); ++edge) {
    FittedSide side{.element = {-1, -1}, .corner = {-1, -1}};
    int count = 0;
    for (const Index f : topology.edge_faces[edge]) {
      if (f < 0 || element[f] < 0) continue;
      side.element[count] = element[f];
      side.corner[count++] = corner_opposite(topology, f, edge);
    }
    if (count == 0) continue;
    const PatchFace& f0 = patches[side.element[0]];
    if (count == 2 && agree(f0, side.corner[0], patches[side.element[1]], side.corner[1])) {
      for (const Index e : side.element) takes_quadratic[e] = true;
      continue;
    }
    stencils.sides.push_back(side);
    sides.push_back(side_patch(topology, f0.face, side.corner[0], X));
  }
  for (std::size_t e = 0; e < patches.size(); ++e) {
    const Index f = patches[e].face;
    append_element(takes_quadratic[e] ? patches[e].patch : Patch(topology, f), {f, -1},
                   BendingModel::kPatch, stencils);
  }
  return sides;
}

}  // namespace

BendingStencils choose_stencils(const Topology& topology,
                                const double* X,
                                std::span<const BendingModel> face_model) {
  BendingStencils stencils;
  const std::vector<Patch> sides = choose_patches(topology, X, face_model, stencils);
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    const auto [f0, f1] = topology.edge_faces[e];
    if (f1 < 0) continue;
    if (face_model[f0] != BendingModel::kHinge || face_model[f1] != BendingModel::kHinge) continue;
    Patch patch(topology, f0);
    patch.add_across(corner_opposite(topology, f0, static_cast<Index>(e)));
    // Two faces on the same three vertices have no hinge.
    if (!alone(patch)) append_element(patch, {f0, f1}, BendingModel::kHinge, stencils);
  }
  for (const Patch& side : sides) append_chart(side, stencils);
  gather_vertices(stencils);
  return stencils;
}

}  // namespace diffcloth::mesh
