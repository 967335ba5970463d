#pragma once

#include <algorithm>
#include <array>
#include <span>

#include "common/types.h"
#include "mesh/curvature_fit.h"
#include "mesh/rest_shape.h"
#include "mesh/unfolding.h"

namespace diffcloth::mesh {

/// Points of the mesh, unfolded into the plane of a base triangle.
struct Chart {
  BaseTriangle<double> base;
  int size = 0;
  std::array<Vec2, kMaxPoints> u;             ///< coordinates of each point
  std::array<Foot<double>, kMaxPoints> foot;  ///< foot of each extra point on its edge

  Mat3 frame() const { return Eigen::Map<const Mat3>(base.frame.data()); }
  double area() const { return 0.5 * base.length * base.b; }
};

/// The coordinates of three rest vertices, one after the other.
inline std::array<double, 9> corners(const double* X, const std::array<Index, 3>& v) {
  std::array<double, 9> result;
  for (int c = 0; c < 3; ++c) {
    result[c] = X[3 * v[0] + c];
    result[3 + c] = X[3 * v[1] + c];
    result[6 + c] = X[3 * v[2] + c];
  }
  return result;
}

/// Call with the ends of an edge in the rest mesh and its share in the mean: once, or for both edges of
/// a seam.
template <class Function>
void for_each_rest_edge(const Topology& topology, std::size_t e, const Function& function) {
  const RestEdge& edge = topology.rest_edges[e];
  const double share = edge.is_seam() ? 0.5 : 1.0;
  function(edge.first[0], edge.first[1], share);
  if (edge.is_seam()) function(edge.last[0], edge.last[1], share);
}

/// Points of a chart that consists of its base face alone, from the rest vertices of that face.
inline std::array<Unfolding, 3> base_points(const std::array<Index, 3>& rest_face) {
  const Unfolding corner{.edge = {-1, -1}, .rest = rest_face};
  return {corner, corner, corner};
}

inline Chart chart(std::span<const Unfolding> points, const double* X) {
  Chart result;
  result.base = base_triangle(corners(X, points[0].rest));
  result.size = static_cast<int>(points.size());
  result.u[0] = Vec2::Zero();
  result.u[1] = Vec2(result.base.length, 0.0);
  result.u[2] = Vec2(result.base.a, result.base.b);
  for (int j = 3; j < result.size; ++j) {
    const auto [a, b] = points[j].edge;
    result.foot[j] = unfold(corners(X, points[j].rest));
    result.u[j] = place(result.u[a], result.u[b], result.foot[j]);
  }
  return result;
}

/// The equation of extra point j.
inline std::array<double, 5> fit_parameters(const Chart& chart, int j) {
  return {chart.base.length, chart.base.a, chart.base.b, chart.u[j].x(), chart.u[j].y()};
}

inline FitMatrix fit_matrix(const Chart& chart) {
  FitMatrix M = FitMatrix::Zero(std::max(chart.size - 3, 3), 3);
  for (int j = 3; j < chart.size; ++j) {
    const FitRow<double> row = fit_row(fit_parameters(chart, j));
    M.row(j - 3) << row.m[0], row.m[1], row.m[2];
  }
  return M;
}

}  // namespace diffcloth::mesh
