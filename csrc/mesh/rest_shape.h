#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/types.h"
#include "mesh/topology.h"

namespace diffcloth::mesh {

/// Shape gradients of a triangle, one corner a row.
using ShapeGradient = Eigen::Matrix<double, 3, 2>;

/// Discretization of bending at a face.
///
/// Patch: the mean second derivatives over its triangle follow from the derivatives across its sides
/// (see FittedSide). Every quadratic map has its exact energy on every mesh, boundaries included, and a
/// bent plate its stiffness.
///
/// Hinge: the element of Bergou and DiffCloth, three to nine times too stiff, for comparisons.
enum class BendingModel : std::uint8_t { kPatch, kHinge };

/// A side with a fitted derivative (side_derivative.h), used by the patches at both sides. At all other
/// sides the quadratics of both patches have equal derivatives, which are used. Grids with one diagonal
/// and equilateral meshes have no fitted sides away from the boundary.
struct FittedSide {
  std::array<Index, 2> element;  ///< the second is -1 if there is none
  std::array<Index, 2> corner;   ///< corner of the base triangle opposite the side
};

/// Source of a point of a chart: a corner of the base face, or a point unfolded about an edge.
struct Unfolding {
  std::array<Index, 2> edge;  ///< local edge a -> b, to whose right it lies; {-1, -1} for a corner
  std::array<Index, 3> rest;  ///< rest vertices of a, b and the point, all in one face
};

/// Vertices that each bending element couples.
///
/// The first three vertices of an element are the corners of its base face, followed by the other points
/// of its quadratic, unless all its sides are fitted, and by the points of the fitted sides. The points
/// of a quadratic, or of a side, are mapped to the plane of a base face by unfolding the mesh. A seam is
/// unfolded as if sewn flat: the triangle beyond it is scaled until its edge is as long as the edge of
/// the face before it. Stencils are chosen once, from the scene's rest mesh, so that everything is smooth
/// in the rest positions.
struct BendingStencils {
  std::vector<Index> start{0};              ///< [B + 1] into `vertices`
  std::vector<Index> vertices;              ///< [start.back()]
  std::vector<Index> rest_vertices;         ///< [start.back()] for elements without seams
  std::vector<char> sewn;                   ///< [B] true if a seam crosses it: flat at rest
  std::vector<std::array<Index, 2>> faces;  ///< [B] base face; other face of a hinge or -1
  std::vector<BendingModel> model;          ///< [B]
  std::vector<FittedSide> sides;            ///< [S]
  std::vector<Index> chart_start{0};        ///< [B + S + 1] into `chart_points`
  std::vector<Index> chart_points;          ///< points of each element, then of each side
  std::vector<Unfolding> unfoldings;        ///< [chart_start.back()]

  Index size() const { return static_cast<Index>(faces.size()); }
  std::span<const Index> element(Index e) const {
    return {vertices.data() + start[e], static_cast<std::size_t>(start[e + 1] - start[e])};
  }
  std::span<const Index> rest_element(Index e) const {
    return {rest_vertices.data() + start[e], static_cast<std::size_t>(start[e + 1] - start[e])};
  }
  Index chart_count() const { return static_cast<Index>(chart_start.size()) - 1; }
  Index side_chart(Index s) const { return size() + s; }
  std::span<const Index> points(Index chart) const {
    return {chart_points.data() + chart_start[chart],
            static_cast<std::size_t>(chart_start[chart + 1] - chart_start[chart])};
  }
  std::span<const Unfolding> unfolding(Index chart) const {
    return {unfoldings.data() + chart_start[chart], points(chart).size()};
  }
};

/// One patch for each face with this model and a neighbor; one hinge for each interior edge between two
/// faces with that model.
///
/// @param X           positions of the rest vertices, [M, 3] [m]
/// @param face_model  one a face
BendingStencils choose_stencils(const Topology& topology,
                                const double* X,
                                std::span<const BendingModel> face_model);

/// Quantities that the potentials compute from the rest positions X.
///
/// Each face has the orthonormal rest frame r1 = (X1 - X0) / |.|, r2 = n x r1 and coordinates
/// (u, v) in it.
struct RestShape {
  std::vector<double> area;                   ///< [F] [m^2]
  std::vector<ShapeGradient> shape_gradient;  ///< [F] rows g_p: F = sum_p x_p g_p^T [1/m]
  /// [start.back()] x 3: the weights (c_uu, c_uv, c_vv) of each stencil vertex,
  /// x,ab = sum_i c_ab,i x_i [1/m^2].
  std::vector<double> curvature_operator;
  /// [B] columns b_uu, b_uv, b_vv: second derivatives X,ab in the rest frame (r1, r2, n) [1/m]; 0 for
  /// sewn elements.
  std::vector<Mat3> curvature;
  std::vector<double> bending_area;    ///< [B] weight of an element: A of a patch, 1 of a hinge
  std::vector<double> vertex_area;     ///< [N] a third of the adjacent faces [m^2]
  std::vector<double> edge_area;       ///< [E] a third of the adjacent faces [m^2]
  std::vector<double> edge_length_sq;  ///< [E] mean over both faces, which differ at a seam [m^2]
  bool curved = false;                 ///< some curvature exceeds rounding; others are exactly 0
};

RestShape rest_shape(const Topology& topology, const BendingStencils& stencils, const double* X);

/// Cotangents of the fields of RestShape, in the same layout.
struct RestShapeBar {
  std::vector<double> area;
  std::vector<ShapeGradient> shape_gradient;
  std::vector<double> curvature_operator;
  std::vector<Mat3> curvature;
  std::vector<double> bending_area;
  std::vector<double> vertex_area;
  std::vector<double> edge_area;
  std::vector<double> edge_length_sq;

  RestShapeBar() = default;
  /// All zero.
  RestShapeBar(const Topology& topology, const BendingStencils& stencils);

  RestShapeBar& operator+=(const RestShapeBar& other);
};

/// X_bar += (d rest_shape / dX)^T bar.
///
/// A curvature that rest_shape() rounds to zero is differentiated as it is before rounding: a flat
/// rest shape has a first-order effect on a bent sheet.
void rest_shape_vjp(const Topology& topology,
                    const BendingStencils& stencils,
                    const double* X,
                    const RestShapeBar& bar,
                    double* X_bar);

/// (d rest_shape / dX) X_dot, as in rest_shape_vjp(); cotangents and tangents have the same layout.
RestShapeBar rest_shape_jvp(const Topology& topology,
                            const BendingStencils& stencils,
                            const double* X,
                            const double* X_dot);

}  // namespace diffcloth::mesh
