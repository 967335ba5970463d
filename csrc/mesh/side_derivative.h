#pragma once

#include "common/types.h"
#include "mesh/curvature_fit.h"

namespace diffcloth::mesh {

// The derivative across a side as a weighted sum of its stencil's positions: weights w with sum_i w_i
// f(u_i) = the mean of df/dn over the side a -> b, n to its right. Affine functions are exact,
// quadratics as far as the points determine them, and cubics as nearly as possible: a fit of quadratics
// alone mistakes a cubic along long edges for a curvature across them, with an error that is the cube of
// the aspect ratio.

using SidePoints = Eigen::Matrix<double, Eigen::Dynamic, 2, 0, kMaxPoints, 2>;
using SideWeights = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMaxPoints, 1>;

/// Points of a stencil in the plane, and the indices of a and b among them.
struct SideStencil {
  SidePoints u;
  int a = 0, b = 0;
};

SideWeights side_derivative(const SideStencil& stencil);

/// Cotangent of the points from the cotangent of side_derivative().
SidePoints side_derivative_vjp(const SideStencil& stencil, const SideWeights& w_bar);

/// (d side_derivative / du) u_dot.
SideWeights side_derivative_jvp(const SideStencil& stencil, const SidePoints& u_dot);

/// Quality of a stencil for the derivative across its side.
struct SideQuality {
  int determined = 0;  ///< number of determined quadratics, at most three
  double size =
      0.0;  ///< size of w relative to the derivative in coordinates that make the points round
  double error = 0.0;  ///< sum of squares of quadratic and cubic errors [1/m^2]

  bool good() const;
  bool better_than(const SideQuality& other) const;
};
SideQuality side_quality(const SideStencil& stencil);

}  // namespace diffcloth::mesh
