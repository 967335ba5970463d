#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "mesh/fit_operator.h"
#include "mesh/local_chart.h"
#include "mesh/rest_shape.h"

namespace diffcloth::mesh {

using OperatorMap = Eigen::Map<Eigen::Matrix<double, 3, Eigen::Dynamic>>;
using ConstOperatorMap = Eigen::Map<const Eigen::Matrix<double, 3, Eigen::Dynamic>>;

/// Charts and operators of the quadratics of all elements.
struct Fits {
  std::vector<Chart> chart;
  std::vector<Operator> c;

  Fits(const BendingStencils& stencils, const double* X) {
    for (Index e = 0; e < stencils.size(); ++e) {
      chart.push_back(element_chart(stencils, e, X));
      c.push_back(fit_operator(stencils, e, chart.back()));
    }
  }
};

/// Place of each point of the fit of element `from` among the vertices of element e.
inline std::vector<Index> places(const BendingStencils& stencils, Index e, Index from) {
  const std::span<const Index> vertices = stencils.element(e);
  std::vector<Index> result;
  for (const Index v : stencils.fit(from)) {
    result.push_back(static_cast<Index>(std::ranges::find(vertices, v) - vertices.begin()));
  }
  return result;
}

/// The two sides of a kink: the element's own and its neighbor's.
inline std::array<std::array<Index, 2>, 2> sides(const Kink& kink) {
  return {{{kink.element, kink.corner}, {kink.other, kink.other_corner}}};
}

// The quadratics of two neighbors disagree about the derivative across their side; with the mean of
// both, the second derivatives of a triangle become
//
//   c_T <- c_T - 1/2 sum_sides N (d_T + d_T')
//
// with d the outward derivatives at the middle of the side. The sum of A c over all triangles is
// then a boundary term: a constant curvature leaves no force on an interior vertex, and the mesh
// cannot relax below the energy of a quadratic by moving single vertices. Quadratics have no kink.
inline std::vector<double> curvature_operator(const BendingStencils& stencils, const Fits& fits) {
  std::vector<double> result(3 * stencils.vertices.size(), 0.0);
  const auto columns = [&](Index e) {
    return OperatorMap(result.data() + 3 * stencils.start[e], 3,
                       stencils.start[e + 1] - stencils.start[e]);
  };
  for (Index e = 0; e < stencils.size(); ++e) columns(e).leftCols(fits.c[e].cols()) = fits.c[e];
  for (const Kink& kink : stencils.kinks) {
    OperatorMap c = columns(kink.element);
    const Side<double> own = side(base_parameters(fits.chart[kink.element]), kink.corner);
    for (const auto& [e, corner] : sides(kink)) {
      const SideWeights d = side_weights(side(base_parameters(fits.chart[e]), corner), fits.c[e]);
      const std::vector<Index> place = places(stencils, kink.element, e);
      for (std::size_t i = 0; i < place.size(); ++i) {
        c.col(place[i]) -= 0.5 * d(i) * Eigen::Map<const Vec3>(own.N.data());
      }
    }
  }
  return result;
}

/// Second derivatives sum_i c_ab,i X_i, one a column.
inline Mat3 second_derivatives(std::span<const Index> vertices,
                               const ConstOperatorMap& c,
                               const double* X) {
  const Vec3 origin = row(X, vertices[0]);
  Mat3 result = Mat3::Zero();
  for (std::size_t i = 1; i < vertices.size(); ++i) {
    result += (row(X, vertices[i]) - origin) * c.col(static_cast<int>(i)).transpose();
  }
  return result;
}

}  // namespace diffcloth::mesh
