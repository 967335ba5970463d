#include "mesh/rest_shape.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/dual.h"
#include "mesh/curvature_fit.h"
#include "mesh/local_chart.h"
#include "mesh/unfolding.h"

namespace diffcloth::mesh {
namespace {

using Dual5 = Dual<5>;
using Dual8 = Dual<8>;
using Dual9 = Dual<9>;

/// Weights (c_uu, c_uv, c_vv) of each vertex of an element, one vertex a column.
using Operator = Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, kMaxPatch>;

/// The unknown of the fit is (x,uu ; sqrt2 x,uv ; x,vv), whose norm does not depend on the frame.
const Vec3 kUnknownScale(1.0, std::sqrt(0.5), 1.0);

template <int n>
std::array<Dual<n>, n> variables(const std::array<double, n>& values) {
  std::array<Dual<n>, n> result;
  for (int i = 0; i < n; ++i) result[i] = Dual<n>::variable(values[i], i);
  return result;
}

Chart element_chart(const BendingStencils& stencils, Index e, const double* X) {
  const std::span<const Index> vertices = stencils.element(e);
  return chart(vertices, {stencils.unfold_edge.data() + stencils.start[e], vertices.size()}, X);
}

/// Shape gradients of the triangle (0, 0), (length, 0), (a, b).
template <class Scalar>
std::array<Scalar, 6> shape_gradient(const Scalar& length, const Scalar& a, const Scalar& b) {
  const Scalar g1u = Scalar(1.0) / length;
  const Scalar g1v = -a / (length * b);
  const Scalar g2v = Scalar(1.0) / b;
  return {-g1u, -(g1v + g2v), g1u, g1v, Scalar(0.0), g2v};
}

// ---- the curvature operator of a patch ----

Operator patch_operator(const Chart& chart) {
  const FitInverse inverse = fit_inverse(fit_matrix(chart)) / chart.area();
  Operator c = Operator::Zero(3, chart.size);
  for (int j = 3; j < chart.size; ++j) {
    const Vec3 weight = kUnknownScale.cwiseProduct(inverse.col(j - 3));
    const FitRow<double> row = fit_row(fit_parameters(chart, j));
    c.col(j) = weight;
    for (int i = 0; i < 3; ++i) c.col(i) -= row.lambda[i] * weight;
  }
  return c;
}

/// Cotangents of the chart: base triangle and local coordinates.
struct ChartBar {
  double length = 0.0, a = 0.0, b = 0.0;
  std::array<double, 9> frame{};
  std::array<Vec2, kMaxPatch> u;

  ChartBar() { u.fill(Vec2::Zero()); }
};

void add_area_bar(const Chart& chart, double area_bar, ChartBar& bar) {
  bar.length += 0.5 * chart.base.b * area_bar;
  bar.b += 0.5 * chart.base.length * area_bar;
}

void patch_operator_vjp(const Chart& chart, const Operator& c_bar, ChartBar& bar) {
  const FitMatrix M = fit_matrix(chart);
  const double area = chart.area();
  const FitInverse inverse = fit_inverse(M) / area;
  FitInverse inverse_bar = FitInverse::Zero(3, M.rows());
  std::array<Vec3, kMaxPatch> lambda_bar;
  for (int j = 3; j < chart.size; ++j) {
    const FitRow<double> row = fit_row(fit_parameters(chart, j));
    const Vec3 weight = kUnknownScale.cwiseProduct(inverse.col(j - 3));
    Vec3 weight_bar = c_bar.col(j);
    for (int i = 0; i < 3; ++i) {
      weight_bar -= row.lambda[i] * c_bar.col(i);
      lambda_bar[j](i) = -weight.dot(c_bar.col(i));
    }
    inverse_bar.col(j - 3) = kUnknownScale.cwiseProduct(weight_bar);
  }
  add_area_bar(chart, -inverse.cwiseProduct(inverse_bar).sum() / area, bar);
  const FitMatrix M_bar = fit_inverse_vjp(M, inverse_bar / area);

  for (int j = 3; j < chart.size; ++j) {
    const FitRow<Dual5> row = fit_row(variables<5>(fit_parameters(chart, j)));
    Eigen::Matrix<double, 5, 1> p_bar = Eigen::Matrix<double, 5, 1>::Zero();
    for (int k = 0; k < 3; ++k) {
      p_bar += lambda_bar[j](k) * row.lambda[k].derivative + M_bar(j - 3, k) * row.m[k].derivative;
    }
    bar.length += p_bar(0);
    bar.a += p_bar(1);
    bar.b += p_bar(2);
    bar.u[j] += p_bar.tail<2>();
  }
}

// ---- the operator of a hinge ----

/// Weights of Bergou's hinge, sqrt(3 / (A0 + A1)) sum_i w_i x_i with cotangent weights w, about the
/// edge a -> b with c to its left and d to its right.
///
/// @param u  coordinates of a, b, c, d
template <class Scalar>
std::array<Scalar, 4> hinge_weights(const std::array<Scalar, 8>& u) {
  using std::sqrt;
  const auto dot = [&u](int o, int p, int q) {
    return (u[2 * p] - u[2 * o]) * (u[2 * q] - u[2 * o]) +
           (u[2 * p + 1] - u[2 * o + 1]) * (u[2 * q + 1] - u[2 * o + 1]);
  };
  const auto cross = [&u](int o, int p, int q) {
    return (u[2 * p] - u[2 * o]) * (u[2 * q + 1] - u[2 * o + 1]) -
           (u[2 * p + 1] - u[2 * o + 1]) * (u[2 * q] - u[2 * o]);
  };
  const Scalar area_c = cross(0, 1, 2);  // twice the areas
  const Scalar area_d = cross(1, 0, 3);
  const Scalar cot_ac = dot(0, 1, 2) / area_c;
  const Scalar cot_bc = dot(1, 0, 2) / area_c;
  const Scalar cot_ad = dot(0, 1, 3) / area_d;
  const Scalar cot_bd = dot(1, 0, 3) / area_d;
  const Scalar scale = sqrt(Scalar(6.0) / (area_c + area_d));
  return {scale * (cot_bc + cot_bd),
          scale * (cot_ac + cot_ad),
          -(scale * (cot_ac + cot_bc)),
          -(scale * (cot_ad + cot_bd))};
}

/// Local vertices a, b, c, d of a hinge.
std::array<int, 4> hinge_corners(const BendingStencils& stencils, Index e) {
  const auto [a, b] = stencils.unfold_edge[stencils.start[e] + 3];
  return {a, b, 3 - a - b, 3};
}

std::array<double, 8> hinge_coordinates(const Chart& chart, const std::array<int, 4>& corner) {
  std::array<double, 8> u;
  for (int i = 0; i < 4; ++i) {
    u[2 * i] = chart.u[corner[i]].x();
    u[2 * i + 1] = chart.u[corner[i]].y();
  }
  return u;
}

Operator hinge_operator(const Chart& chart, const std::array<int, 4>& corner) {
  const std::array<double, 4> w = hinge_weights(hinge_coordinates(chart, corner));
  Operator c = Operator::Zero(3, 4);
  for (int i = 0; i < 4; ++i) c(0, corner[i]) = w[i];
  return c;
}

void hinge_operator_vjp(const Chart& chart,
                        const std::array<int, 4>& corner,
                        const Operator& c_bar,
                        ChartBar& bar) {
  const std::array<Dual8, 4> w = hinge_weights(variables<8>(hinge_coordinates(chart, corner)));
  for (int i = 0; i < 4; ++i) {
    for (int k = 0; k < 4; ++k) {
      bar.u[corner[k]] += c_bar(0, corner[i]) * w[i].derivative.segment<2>(2 * k);
    }
  }
}

Operator element_operator(const BendingStencils& stencils, Index e, const Chart& chart) {
  switch (stencils.model[e]) {
    case BendingModel::kPatch:
      return patch_operator(chart);
    case BendingModel::kHinge:
      return hinge_operator(chart, hinge_corners(stencils, e));
  }
  return {};
}

/// Second derivatives sum_i c_ab,i X_i, one a column.
Mat3 second_derivatives(std::span<const Index> vertices, const Operator& c, const double* X) {
  const Vec3 origin = row(X, vertices[0]);
  Mat3 result = Mat3::Zero();
  for (std::size_t i = 1; i < vertices.size(); ++i) {
    result += (row(X, vertices[i]) - origin) * c.col(static_cast<int>(i)).transpose();
  }
  return result;
}

/// Curvature times element size below which a rest shape is flat: rounding of the curvature
/// itself, and of coordinates far from the origin.
double flat_threshold(const Topology& topology, const double* X, double area) {
  double extent = 0.0;
  for (Index i = 0; i < 3 * topology.vertex_count; ++i) extent = std::max(extent, std::abs(X[i]));
  return std::max(1e-12, 32.0 * std::numeric_limits<double>::epsilon() * extent / std::sqrt(area));
}

// ---- from the chart back to rest positions ----

void add_corner_bar(std::span<const Dual9> outputs,
                    std::span<const double> bars,
                    Index i,
                    Index j,
                    Index k,
                    double* X_bar) {
  Eigen::Matrix<double, 9, 1> total = Eigen::Matrix<double, 9, 1>::Zero();
  for (std::size_t o = 0; o < outputs.size(); ++o) total += bars[o] * outputs[o].derivative;
  const std::array<Index, 3> vertices{i, j, k};
  for (int p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(X_bar + 3 * vertices[p]) += total.segment<3>(3 * p);
  }
}

void base_triangle_vjp(const std::array<Index, 3>& v,
                       const double* X,
                       const ChartBar& bar,
                       double* X_bar) {
  const BaseTriangle<Dual9> base = base_triangle(variables<9>(corners(X, v[0], v[1], v[2])));
  std::array<Dual9, 12> outputs{base.length, base.a, base.b};
  std::array<double, 12> bars{bar.length, bar.a, bar.b};
  std::copy(base.frame.begin(), base.frame.end(), outputs.begin() + 3);
  std::copy(bar.frame.begin(), bar.frame.end(), bars.begin() + 3);
  add_corner_bar(outputs, bars, v[0], v[1], v[2], X_bar);
}

/// Undo chart(), last vertex first: u_j = u_a + along (u_b - u_a) + off right(u_b - u_a).
void chart_vjp(std::span<const Index> vertices,
               std::span<const std::array<Index, 2>> unfold_edge,
               const Chart& chart,
               const double* X,
               ChartBar& bar,
               double* X_bar) {
  for (int j = chart.size - 1; j >= 3; --j) {
    const auto [a, b] = unfold_edge[j];
    const Vec2 edge = chart.u[b] - chart.u[a];
    const Vec2 u_bar = bar.u[j];
    const auto [along, off] = chart.foot[j];
    const std::array<double, 2> foot_bar{u_bar.dot(edge), u_bar.dot(Vec2(edge.y(), -edge.x()))};
    const Vec2 edge_bar = along * u_bar + off * Vec2(-u_bar.y(), u_bar.x());
    bar.u[a] += u_bar - edge_bar;
    bar.u[b] += edge_bar;

    const Foot<Dual9> foot = unfold(variables<9>(corners(X, vertices[a], vertices[b], vertices[j])));
    const std::array<Dual9, 2> outputs{foot.along, foot.off};
    add_corner_bar(outputs, foot_bar, vertices[a], vertices[b], vertices[j], X_bar);
  }
  bar.length += bar.u[1].x();
  bar.a += bar.u[2].x();
  bar.b += bar.u[2].y();
  base_triangle_vjp({vertices[0], vertices[1], vertices[2]}, X, bar, X_bar);
}

void element_vjp(const BendingStencils& stencils,
                 Index e,
                 const double* X,
                 const RestShapeBar& bar,
                 double* X_bar) {
  const std::span<const Index> vertices = stencils.element(e);
  const Chart local = element_chart(stencils, e, X);
  const Operator c = element_operator(stencils, e, local);
  ChartBar local_bar;
  if (stencils.model[e] == BendingModel::kPatch) {
    add_area_bar(local, bar.bending_area[e], local_bar);
  }

  // b = R^T sum_i (X_i - X_0) c_i^T
  const Mat3& b_bar = bar.curvature[e];
  const Mat3 Y_bar = local.frame() * b_bar;
  const Mat3 frame_bar = second_derivatives(vertices, c, X) * b_bar.transpose();
  Eigen::Map<Mat3>(local_bar.frame.data()) = frame_bar;
  Operator c_bar = Eigen::Map<const Eigen::Matrix<double, 3, Eigen::Dynamic>>(
      bar.curvature_operator.data() + 3 * stencils.start[e], 3, local.size);
  const Vec3 origin = row(X, vertices[0]);
  for (int i = 0; i < local.size; ++i) {
    c_bar.col(i) += Y_bar.transpose() * (row(X, vertices[i]) - origin);
    Eigen::Map<Vec3>(X_bar + 3 * vertices[i]) += Y_bar * c.col(i);
  }

  switch (stencils.model[e]) {
    case BendingModel::kPatch:
      patch_operator_vjp(local, c_bar, local_bar);
      break;
    case BendingModel::kHinge:
      hinge_operator_vjp(local, hinge_corners(stencils, e), c_bar, local_bar);
      break;
  }
  chart_vjp(vertices,
            {stencils.unfold_edge.data() + stencils.start[e], vertices.size()},
            local,
            X,
            local_bar,
            X_bar);
}

void face_vjp(const Topology& topology,
              Index f,
              const double* X,
              const RestShapeBar& bar,
              double* X_bar) {
  const std::array<Index, 3>& face = topology.faces[f];
  const Chart local = chart(face, {}, X);
  double area_bar = bar.area[f];
  for (int p = 0; p < 3; ++p) {
    area_bar += (bar.vertex_area[face[p]] + bar.edge_area[topology.face_edges[f][p]]) / 3.0;
  }
  ChartBar local_bar;
  add_area_bar(local, area_bar, local_bar);

  const std::array<Dual<3>, 3> base =
      variables<3>({local.base.length, local.base.a, local.base.b});
  const std::array<Dual<3>, 6> g = shape_gradient(base[0], base[1], base[2]);
  Vec3 base_bar = Vec3::Zero();
  for (int k = 0; k < 6; ++k) base_bar += bar.shape_gradient[f](k / 2, k % 2) * g[k].derivative;
  local_bar.length += base_bar(0);
  local_bar.a += base_bar(1);
  local_bar.b += base_bar(2);
  base_triangle_vjp(face, X, local_bar, X_bar);
}

void fill_faces(const Topology& topology, const double* X, RestShape& rest) {
  const Index face_count = static_cast<Index>(topology.faces.size());
  rest.area.resize(face_count);
  rest.shape_gradient.resize(face_count);
  rest.vertex_area.assign(topology.vertex_count, 0.0);
  rest.edge_area.assign(topology.edges.size(), 0.0);
  rest.edge_length_sq.resize(topology.edges.size());
  for (Index f = 0; f < face_count; ++f) {
    const std::array<Index, 3>& face = topology.faces[f];
    const Chart local = chart(face, {}, X);
    const std::array<double, 6> g =
        shape_gradient(local.base.length, local.base.a, local.base.b);
    for (int k = 0; k < 6; ++k) rest.shape_gradient[f](k / 2, k % 2) = g[k];
    rest.area[f] = local.area();
    for (int p = 0; p < 3; ++p) {
      rest.vertex_area[face[p]] += rest.area[f] / 3.0;
      rest.edge_area[topology.face_edges[f][p]] += rest.area[f] / 3.0;
    }
  }
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    const auto [v0, v1] = topology.edges[e];
    rest.edge_length_sq[e] = (row(X, v1) - row(X, v0)).squaredNorm();
  }
}

}  // namespace

RestShape rest_shape(const Topology& topology, const BendingStencils& stencils, const double* X) {
  RestShape rest;
  fill_faces(topology, X, rest);
  rest.curvature_operator.resize(3 * stencils.vertices.size());
  rest.curvature.resize(stencils.size());
  rest.bending_area.resize(stencils.size());
  for (Index e = 0; e < stencils.size(); ++e) {
    const Chart local = element_chart(stencils, e, X);
    const Operator c = element_operator(stencils, e, local);
    std::copy(c.data(), c.data() + c.size(), rest.curvature_operator.data() + 3 * stencils.start[e]);
    const bool patch = stencils.model[e] == BendingModel::kPatch;
    rest.bending_area[e] = patch ? local.area() : 1.0;
    rest.curvature[e] = local.frame().transpose() *
                        second_derivatives(stencils.element(e), c, X);
  }
  if (rest.area.empty()) return rest;

  // A hinge's row is the curvature times the square root of an area.
  const double threshold =
      flat_threshold(topology, X, *std::min_element(rest.area.begin(), rest.area.end()));
  for (Index e = 0; e < stencils.size(); ++e) {
    const bool patch = stencils.model[e] == BendingModel::kPatch;
    const double size = patch ? std::sqrt(rest.bending_area[e]) : 1.0;
    if (rest.curvature[e].cwiseAbs().maxCoeff() * size > threshold) {
      rest.curved = true;
    } else {
      rest.curvature[e].setZero();
    }
  }
  return rest;
}

RestShapeBar::RestShapeBar(const Topology& topology, const BendingStencils& stencils)
    : area(topology.faces.size(), 0.0),
      shape_gradient(topology.faces.size(), ShapeGradient::Zero()),
      curvature_operator(3 * stencils.vertices.size(), 0.0),
      curvature(stencils.faces.size(), Mat3::Zero()),
      bending_area(stencils.faces.size(), 0.0),
      vertex_area(topology.vertex_count, 0.0),
      edge_area(topology.edges.size(), 0.0),
      edge_length_sq(topology.edges.size(), 0.0) {}

void rest_shape_vjp(const Topology& topology,
                    const BendingStencils& stencils,
                    const double* X,
                    const RestShapeBar& bar,
                    double* X_bar) {
  for (Index f = 0; f < static_cast<Index>(topology.faces.size()); ++f) {
    face_vjp(topology, f, X, bar, X_bar);
  }
  for (Index e = 0; e < stencils.size(); ++e) element_vjp(stencils, e, X, bar, X_bar);
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    const auto [v0, v1] = topology.edges[e];
    const Vec3 bar_v1 = 2.0 * bar.edge_length_sq[e] * (row(X, v1) - row(X, v0));
    Eigen::Map<Vec3>(X_bar + 3 * v1) += bar_v1;
    Eigen::Map<Vec3>(X_bar + 3 * v0) -= bar_v1;
  }
}

}  // namespace diffcloth::mesh
