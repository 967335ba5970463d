#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "mesh/fit_operator.h"
#include "mesh/local_chart.h"
#include "mesh/rest_shape.h"
#include "mesh/side_derivative.h"

namespace diffcloth::mesh {

using OperatorMap = Eigen::Map<Eigen::Matrix<double, 3, Eigen::Dynamic>>;
using ConstOperatorMap = Eigen::Map<const Eigen::Matrix<double, 3, Eigen::Dynamic>>;

/// The points of a fitted side in the plane of its first element.
inline SideStencil side_stencil(const Chart& chart, Index corner) {
  SideStencil result{.u = SidePoints(chart.size, 2), .a = (corner + 1) % 3, .b = (corner + 2) % 3};
  for (int i = 0; i < chart.size; ++i) result.u.row(i) = chart.u[i].transpose();
  return result;
}

/// Charts of all elements and fitted sides, operators of the quadratics, derivatives of the sides.
struct Fits {
  std::vector<Chart> chart;
  std::vector<Operator> c;     ///< [B]
  std::vector<SideWeights> w;  ///< [S] outward from the first element

  Fits(const BendingStencils& stencils, const double* X) {
    for (Index k = 0; k < stencils.chart_count(); ++k) {
      chart.push_back(mesh::chart(stencils.unfolding(k), X));
    }
    for (Index e = 0; e < stencils.size(); ++e) c.push_back(fit_operator(stencils, e, chart[e]));
    for (std::size_t s = 0; s < stencils.sides.size(); ++s) {
      w.push_back(side_derivative(stencil(stencils, static_cast<Index>(s))));
    }
  }

  SideStencil stencil(const BendingStencils& stencils, Index s) const {
    return side_stencil(chart[stencils.side_chart(s)], stencils.sides[s].corner[0]);
  }
};

/// Index of each point of a chart among the vertices of element e.
inline std::vector<Index> places(const BendingStencils& stencils, Index e, Index chart) {
  const std::span<const Index> vertices = stencils.element(e);
  std::vector<Index> result;
  for (const Index v : stencils.points(chart)) {
    result.push_back(static_cast<Index>(std::ranges::find(vertices, v) - vertices.begin()));
  }
  return result;
}

/// A side of an element whose derivative is fitted.
struct ElementSide {
  Index side;
  Index element, corner;
  double sign;  ///< sign of the side's derivative relative to the outward direction
};

/// Call the function with each element's part of each fitted side, in order.
template <class Function>
void for_each_element_side(const BendingStencils& stencils, const Function& function) {
  for (std::size_t s = 0; s < stencils.sides.size(); ++s) {
    const FittedSide& side = stencils.sides[s];
    for (int i = 0; i < 2; ++i) {
      if (side.element[i] < 0) continue;
      function(ElementSide{.side = static_cast<Index>(s),
                           .element = side.element[i],
                           .corner = side.corner[i],
                           .sign = i == 0 ? 1.0 : -1.0});
    }
  }
}

inline OperatorMap element_columns(const BendingStencils& stencils,
                                   Index e,
                                   std::vector<double>& all) {
  return {all.data() + 3 * static_cast<std::ptrdiff_t>(stencils.start[e]), 3,
          stencils.start[e + 1] - stencils.start[e]};
}

// The mean second derivatives of a triangle are an integral over its boundary,
//
//   A (x,uu ; x,uv ; x,vv) = sum_sides |side| (n n^T dx/dn + sym(n t^T) (x_b - x_a) / |side|),
//
// in which only the derivative across a side depends on the fit. If the fitted derivative of the side
// replaces the derivative of the triangle's quadratic,
//
//   c_T <- c_T + sum_sides N (w - d_T),
//
// d_T is the outward derivative of the quadratic at the middle of the side. Both triangles use the same
// w: the sum of A c over all triangles is a boundary term, a constant curvature leaves no force on an
// interior vertex, and the mesh cannot relax below the energy of a quadratic by moving single vertices.
// If all sides of a triangle are fitted, its quadratic drops out and is linear.
inline std::vector<double> curvature_operator(const BendingStencils& stencils, const Fits& fits) {
  std::vector<double> result(3 * stencils.vertices.size(), 0.0);
  for (Index e = 0; e < stencils.size(); ++e) {
    element_columns(stencils, e, result).leftCols(fits.c[e].cols()) = fits.c[e];
  }
  for_each_element_side(stencils, [&](const ElementSide& part) {
    const Index e = part.element;
    OperatorMap c = element_columns(stencils, e, result);
    const Side<double> own = side(base_parameters(fits.chart[e]), part.corner);
    const Eigen::Map<const Vec3> N(own.N.data());
    const SideWeights d = side_weights(own, fits.c[e]);
    for (Index i = 0; i < d.size(); ++i) c.col(i) -= d(i) * N;
    const std::vector<Index> place = places(stencils, e, stencils.side_chart(part.side));
    for (std::size_t i = 0; i < place.size(); ++i) {
      c.col(place[i]) += part.sign * fits.w[part.side](static_cast<Index>(i)) * N;
    }
  });
  return result;
}

/// Second derivatives sum_i c_ab,i X_i of an element, one a column.
inline Mat3 second_derivatives(std::span<const Index> rest_vertices,
                               const ConstOperatorMap& c,
                               const double* X) {
  const Vec3 origin = row(X, rest_vertices[0]);
  Mat3 result = Mat3::Zero();
  for (std::size_t i = 1; i < rest_vertices.size(); ++i) {
    result += (row(X, rest_vertices[i]) - origin) * c.col(static_cast<int>(i)).transpose();
  }
  return result;
}

}  // namespace diffcloth::mesh
