#pragma once

#include <algorithm>
#include <array>
#include <span>

#include "common/types.h"
#include "mesh/curvature_fit.h"
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

/// The coordinates of three vertices, one after the other.
inline std::array<double, 9> corners(const double* X, Index i, Index j, Index k) {
  std::array<double, 9> result;
  for (int c = 0; c < 3; ++c) {
    result[c] = X[3 * i + c];
    result[3 + c] = X[3 * j + c];
    result[6 + c] = X[3 * k + c];
  }
  return result;
}

inline Chart chart(std::span<const Index> vertices,
                   std::span<const std::array<Index, 2>> unfold_edge,
                   const double* X) {
  Chart result;
  result.base = base_triangle(corners(X, vertices[0], vertices[1], vertices[2]));
  result.size = static_cast<int>(vertices.size());
  result.u[0] = Vec2::Zero();
  result.u[1] = Vec2(result.base.length, 0.0);
  result.u[2] = Vec2(result.base.a, result.base.b);
  for (int j = 3; j < result.size; ++j) {
    const auto [a, b] = unfold_edge[j];
    result.foot[j] = unfold(corners(X, vertices[a], vertices[b], vertices[j]));
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
