#pragma once

#include <array>

#include "common/dual.h"
#include "common/types.h"
#include "mesh/curvature_fit.h"
#include "mesh/local_chart.h"
#include "mesh/rest_shape.h"
#include "mesh/side_derivative.h"

namespace diffcloth::mesh {

/// Weights (c_uu, c_uv, c_vv) of each vertex of the quadratic of an element, one vertex a column.
using Operator = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, kMaxQuadratic>;

/// Cotangents of the chart, or tangents: base triangle and local coordinates.
struct ChartBar {
  double length = 0.0, a = 0.0, b = 0.0;
  std::array<double, 9> frame{};
  std::array<Vec2, kMaxPoints> u;

  ChartBar() { u.fill(Vec2::Zero()); }
};

inline void add_area_bar(const Chart& chart, double area_bar, ChartBar& bar) {
  bar.length += 0.5 * chart.base.b * area_bar;
  bar.b += 0.5 * chart.base.length * area_bar;
}

/// Shape gradients of the triangle (0, 0), (length, 0), (a, b).
template <class Scalar>
std::array<Scalar, 6> shape_gradient(const Scalar& length, const Scalar& a, const Scalar& b) {
  const Scalar g1u = Scalar(1.0) / length;
  const Scalar g1v = -a / (length * b);
  const Scalar g2v = Scalar(1.0) / b;
  return {-g1u, -(g1v + g2v), g1u, g1v, Scalar(0.0), g2v};
}

/// Second derivatives of the quadratic of a triangle and the points across its sides; zero without such
/// points.
Operator patch_operator(const Chart& chart);

/// Second derivatives of an element's quadratic: of a patch, or of a hinge in the row uu.
Operator fit_operator(const BendingStencils& stencils, Index e, const Chart& chart);

/// bar += (d fit_operator / d chart)^T c_bar.
void fit_operator_vjp(const BendingStencils& stencils,
                      Index e,
                      const Chart& chart,
                      const Operator& c_bar,
                      ChartBar& bar);

/// (d fit_operator / d chart) dot.
Operator fit_operator_jvp(const BendingStencils& stencils,
                          Index e,
                          const Chart& chart,
                          const ChartBar& dot);

/// Outward derivative of a base triangle's quadratic across the side opposite a corner: at the middle of
/// the side it is  sum_i (k . c_i + [i < 3] g_i) x_i,  and N is the side's share in the second
/// derivatives of the triangle,
///
///   A (x,uu ; x,uv ; x,vv) = boundary integral of n (x) grad x,
///   N = |side| / A (n1^2, n1 n2, n2^2).
template <class Scalar>
struct Side {
  std::array<Scalar, 3> k, g, N;
};

/// @param base  length, a, b of the base triangle
template <class Scalar>
Side<Scalar> side(const std::array<Scalar, 3>& base, int corner) {
  using std::sqrt;
  const auto& [length, a, b] = base;
  const std::array<Scalar, 3> u{Scalar(0.0), length, a};
  const std::array<Scalar, 3> v{Scalar(0.0), Scalar(0.0), b};
  const std::array<Scalar, 6> gradient = shape_gradient(length, a, b);
  const int p = (corner + 1) % 3, q = (corner + 2) % 3;
  const Scalar du = u[q] - u[p], dv = v[q] - v[p];
  const Scalar size = sqrt(du * du + dv * dv);
  const Scalar n1 = dv / size, n2 = -du / size;
  const Scalar half(0.5);
  const Scalar mid_u = half * (u[p] + u[q]), mid_v = half * (v[p] + v[q]);

  Side<Scalar> result;
  result.k = {n1 * mid_u, n1 * mid_v + n2 * mid_u, n2 * mid_v};
  for (int i = 0; i < 3; ++i) {
    result.g[i] = gradient[2 * i] * n1 + gradient[2 * i + 1] * n2;
    result.k[0] = result.k[0] - half * result.g[i] * u[i] * u[i];
    result.k[1] = result.k[1] - result.g[i] * u[i] * v[i];
    result.k[2] = result.k[2] - half * result.g[i] * v[i] * v[i];
  }
  const Scalar share = Scalar(2.0) * size / (length * b);
  result.N = {share * n1 * n1, share * n1 * n2, share * n2 * n2};
  return result;
}

inline std::array<double, 3> base_parameters(const Chart& chart) {
  return {chart.base.length, chart.base.a, chart.base.b};
}

/// Weights of the outward derivative at the middle of a side, one for each point of the quadratic.
SideWeights side_weights(const Side<double>& side, const Operator& c);

}  // namespace diffcloth::mesh
