#include "mesh/rest_shape.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/dual.h"
#include "mesh/fit_operator.h"
#include "mesh/local_chart.h"
#include "mesh/quadratics.h"
#include "mesh/unfolding.h"

namespace diffcloth::mesh {
namespace {

using Dual3 = Dual<3>;
using Dual9 = Dual<9>;
/// Cotangents of the quadratics of all elements and of the derivatives of all sides.
struct FitsBar {
  std::vector<Operator> c;
  std::vector<Vec3> base;  ///< length, a, b of the base triangles
  std::vector<SideWeights> w;

  explicit FitsBar(const Fits& fits) : base(fits.c.size(), Vec3::Zero()) {
    for (const Operator& operator_e : fits.c) c.emplace_back(Operator::Zero(3, operator_e.cols()));
    for (const SideWeights& weights : fits.w) w.emplace_back(SideWeights::Zero(weights.size()));
  }
};

/// Add the gradient of sum_j bars_j . values_j with respect to the base triangle.
void add_base_bar(const std::array<Dual3, 3>& values, const Vec3& bars, Vec3& base_bar) {
  for (int j = 0; j < 3; ++j) base_bar += bars(j) * values[j].derivative;
}

void element_side_vjp(const BendingStencils& stencils,
                      const Fits& fits,
                      const ElementSide& part,
                      const ConstOperatorMap& c_bar,
                      FitsBar& bar) {
  const Index e = part.element;
  const std::array<double, 3> base = base_parameters(fits.chart[e]);
  const Side<double> own = side(base, part.corner);
  const Eigen::Map<const Vec3> N(own.N.data());
  const SideWeights d = side_weights(own, fits.c[e]);
  Vec3 N_bar = Vec3::Zero();
  Vec3 k_bar = Vec3::Zero();
  Vec3 g_bar = Vec3::Zero();
  for (Index i = 0; i < d.size(); ++i) {
    N_bar -= d(i) * c_bar.col(i);
    const double d_bar = -N.dot(c_bar.col(i));
    bar.c[e].col(i) += d_bar * Eigen::Map<const Vec3>(own.k.data());
    k_bar += d_bar * fits.c[e].col(i);
    if (i < 3) g_bar(i) = d_bar;
  }
  const std::vector<Index> place = places(stencils, e, stencils.side_chart(part.side));
  for (std::size_t i = 0; i < place.size(); ++i) {
    const auto k = static_cast<Index>(i);
    N_bar += part.sign * fits.w[part.side](k) * c_bar.col(place[i]);
    bar.w[part.side](k) += part.sign * N.dot(c_bar.col(place[i]));
  }
  const Side<Dual3> dual = side(variables<3>(base), part.corner);
  add_base_bar(dual.N, N_bar, bar.base[e]);
  add_base_bar(dual.k, k_bar, bar.base[e]);
  add_base_bar(dual.g, g_bar, bar.base[e]);
}

/// Curvature times element size below which a rest shape is flat: the rounding of the curvature and of
/// coordinates far from the origin.
double flat_threshold(const Topology& topology, const double* X, double area) {
  double extent = 0.0;
  for (Index i = 0; i < 3 * topology.rest_vertex_count; ++i)
    extent = std::max(extent, std::abs(X[i]));
  return std::max(1e-12, 32.0 * std::numeric_limits<double>::epsilon() * extent / std::sqrt(area));
}

// ---- from the chart back to rest positions ----

void add_corner_bar(std::span<const Dual9> outputs,
                    std::span<const double> bars,
                    const std::array<Index, 3>& v,
                    double* X_bar) {
  Eigen::Matrix<double, 9, 1> total = Eigen::Matrix<double, 9, 1>::Zero();
  for (std::size_t o = 0; o < outputs.size(); ++o) total += bars[o] * outputs[o].derivative;
  for (int p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(X_bar + 3 * v[p]) += total.segment<3>(3 * p);
  }
}

void base_triangle_vjp(const std::array<Index, 3>& v,
                       const double* X,
                       const ChartBar& bar,
                       double* X_bar) {
  const BaseTriangle<Dual9> base = base_triangle(variables<9>(corners(X, v)));
  std::array<Dual9, 12> outputs{base.length, base.a, base.b};
  std::array<double, 12> bars{bar.length, bar.a, bar.b};
  std::copy(base.frame.begin(), base.frame.end(), outputs.begin() + 3);
  std::copy(bar.frame.begin(), bar.frame.end(), bars.begin() + 3);
  add_corner_bar(outputs, bars, v, X_bar);
}

/// Undo chart(), last vertex first: u_j = u_a + along (u_b - u_a) + off right(u_b - u_a).
void chart_vjp(std::span<const Unfolding> points,
               const Chart& chart,
               const double* X,
               ChartBar& bar,
               double* X_bar) {
  for (int j = chart.size - 1; j >= 3; --j) {
    const auto [a, b] = points[j].edge;
    const Vec2 edge = chart.u[b] - chart.u[a];
    const Vec2 u_bar = bar.u[j];
    const auto [along, off] = chart.foot[j];
    const std::array<double, 2> foot_bar{u_bar.dot(edge), u_bar.dot(Vec2(edge.y(), -edge.x()))};
    const Vec2 edge_bar = along * u_bar + off * Vec2(-u_bar.y(), u_bar.x());
    bar.u[a] += u_bar - edge_bar;
    bar.u[b] += edge_bar;

    const Foot<Dual9> foot = unfold(variables<9>(corners(X, points[j].rest)));
    const std::array<Dual9, 2> outputs{foot.along, foot.off};
    add_corner_bar(outputs, foot_bar, points[j].rest, X_bar);
  }
  bar.length += bar.u[1].x();
  bar.a += bar.u[2].x();
  bar.b += bar.u[2].y();
  base_triangle_vjp(points[0].rest, X, bar, X_bar);
}

/// Pull back b = R^T sum_i (X_i - X_0) c_i^T to X, to the frame R and to c.
void curvature_vjp(std::span<const Index> vertices,
                   const ConstOperatorMap& c,
                   const double* X,
                   const Mat3& b_bar,
                   const Mat3& frame,
                   Mat3& frame_bar,
                   OperatorMap c_bar,
                   double* X_bar) {
  const Mat3 Y_bar = frame * b_bar;
  frame_bar = second_derivatives(vertices, c, X) * b_bar.transpose();
  const Vec3 origin = row(X, vertices[0]);
  for (std::size_t i = 0; i < vertices.size(); ++i) {
    c_bar.col(i) += Y_bar.transpose() * (row(X, vertices[i]) - origin);
    Eigen::Map<Vec3>(X_bar + 3 * vertices[i]) += Y_bar * c.col(i);
  }
}

void bending_vjp(const BendingStencils& stencils,
                 const double* X,
                 const RestShapeBar& bar,
                 double* X_bar) {
  const Fits fits(stencils, X);
  const std::vector<double> c = curvature_operator(stencils, fits);
  std::vector<double> c_bar = bar.curvature_operator;
  FitsBar fits_bar(fits);
  std::vector<ChartBar> chart_bar(fits.chart.size());
  for (Index e = 0; e < stencils.size(); ++e) {
    const auto size = static_cast<Index>(stencils.element(e).size());
    const std::ptrdiff_t offset = 3 * static_cast<std::ptrdiff_t>(stencils.start[e]);
    OperatorMap element_bar = element_columns(stencils, e, c_bar);
    if (stencils.sewn[e] == 0) {
      Mat3 frame_bar;
      curvature_vjp(stencils.rest_element(e), ConstOperatorMap(c.data() + offset, 3, size), X,
                    bar.curvature[e], fits.chart[e].frame(), frame_bar, element_bar, X_bar);
      Eigen::Map<Mat3>(chart_bar[e].frame.data()) = frame_bar;
    }
    fits_bar.c[e] += element_bar.leftCols(fits.c[e].cols());
  }
  for_each_element_side(stencils, [&](const ElementSide& part) {
    const OperatorMap columns = element_columns(stencils, part.element, c_bar);
    element_side_vjp(stencils, fits, part, ConstOperatorMap(columns.data(), 3, columns.cols()),
                     fits_bar);
  });
  for (Index e = 0; e < stencils.size(); ++e) {
    const Chart& local = fits.chart[e];
    if (stencils.model[e] == BendingModel::kPatch) {
      add_area_bar(local, bar.bending_area[e], chart_bar[e]);
    }
    chart_bar[e].length += fits_bar.base[e](0);
    chart_bar[e].a += fits_bar.base[e](1);
    chart_bar[e].b += fits_bar.base[e](2);
    fit_operator_vjp(stencils, e, local, fits_bar.c[e], chart_bar[e]);
  }
  for (std::size_t s = 0; s < stencils.sides.size(); ++s) {
    const auto side = static_cast<Index>(s);
    const SidePoints u_bar = side_derivative_vjp(fits.stencil(stencils, side), fits_bar.w[side]);
    ChartBar& local_bar = chart_bar[stencils.side_chart(side)];
    for (Index i = 0; i < u_bar.rows(); ++i) local_bar.u[i] = u_bar.row(i).transpose();
  }
  for (Index k = 0; k < stencils.chart_count(); ++k) {
    chart_vjp(stencils.unfolding(k), fits.chart[k], X, chart_bar[k], X_bar);
  }
}

void face_vjp(
    const Topology& topology, Index f, const double* X, const RestShapeBar& bar, double* X_bar) {
  const std::array<Index, 3>& face = topology.faces[f];
  const Chart local = chart(base_points(topology.rest_faces[f]), X);
  double area_bar = bar.area[f];
  for (int p = 0; p < 3; ++p) {
    area_bar += (bar.vertex_area[face[p]] + bar.edge_area[topology.face_edges[f][p]]) / 3.0;
  }
  ChartBar local_bar;
  add_area_bar(local, area_bar, local_bar);

  const std::array<Dual3, 3> base = variables<3>({local.base.length, local.base.a, local.base.b});
  const std::array<Dual3, 6> g = shape_gradient(base[0], base[1], base[2]);
  Vec3 base_bar = Vec3::Zero();
  for (int k = 0; k < 6; ++k) base_bar += bar.shape_gradient[f](k / 2, k % 2) * g[k].derivative;
  local_bar.length += base_bar(0);
  local_bar.a += base_bar(1);
  local_bar.b += base_bar(2);
  base_triangle_vjp(topology.rest_faces[f], X, local_bar, X_bar);
}

void fill_faces(const Topology& topology, const double* X, RestShape& rest) {
  const auto face_count = static_cast<Index>(topology.faces.size());
  rest.area.resize(face_count);
  rest.shape_gradient.resize(face_count);
  rest.vertex_area.assign(topology.vertex_count, 0.0);
  rest.edge_area.assign(topology.edges.size(), 0.0);
  rest.edge_length_sq.resize(topology.edges.size());
  for (Index f = 0; f < face_count; ++f) {
    const std::array<Index, 3>& face = topology.faces[f];
    const Chart local = chart(base_points(topology.rest_faces[f]), X);
    const std::array<double, 6> g = shape_gradient(local.base.length, local.base.a, local.base.b);
    for (int k = 0; k < 6; ++k) rest.shape_gradient[f](k / 2, k % 2) = g[k];
    rest.area[f] = local.area();
    for (int p = 0; p < 3; ++p) {
      rest.vertex_area[face[p]] += rest.area[f] / 3.0;
      rest.edge_area[topology.face_edges[f][p]] += rest.area[f] / 3.0;
    }
  }
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    double& length_sq = rest.edge_length_sq[e];
    length_sq = 0.0;
    for_each_rest_edge(topology, e, [&](Index v0, Index v1, double share) {
      length_sq += share * (row(X, v1) - row(X, v0)).squaredNorm();
    });
  }
}

}  // namespace

RestShape rest_shape(const Topology& topology, const BendingStencils& stencils, const double* X) {
  RestShape rest;
  fill_faces(topology, X, rest);
  const Fits fits(stencils, X);
  rest.curvature_operator = curvature_operator(stencils, fits);
  rest.curvature.resize(stencils.size());
  rest.bending_area.resize(stencils.size());
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::span<const Index> rest_vertices = stencils.rest_element(e);
    const ConstOperatorMap c(
        rest.curvature_operator.data() + 3 * static_cast<std::ptrdiff_t>(stencils.start[e]), 3,
        static_cast<Index>(rest_vertices.size()));
    const bool patch = stencils.model[e] == BendingModel::kPatch;
    rest.bending_area[e] = patch ? fits.chart[e].area() : 1.0;
    if (stencils.sewn[e] != 0) {
      rest.curvature[e].setZero();
    } else {
      rest.curvature[e] =
          fits.chart[e].frame().transpose() * second_derivatives(rest_vertices, c, X);
    }
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

RestShapeBar& RestShapeBar::operator+=(const RestShapeBar& other) {
  const auto add = [](auto& to, const auto& from) {
    for (std::size_t k = 0; k < from.size(); ++k) to[k] += from[k];
  };
  add(area, other.area);
  add(shape_gradient, other.shape_gradient);
  add(curvature_operator, other.curvature_operator);
  add(curvature, other.curvature);
  add(bending_area, other.bending_area);
  add(vertex_area, other.vertex_area);
  add(edge_area, other.edge_area);
  add(edge_length_sq, other.edge_length_sq);
  return *this;
}

void rest_shape_vjp(const Topology& topology,
                    const BendingStencils& stencils,
                    const double* X,
                    const RestShapeBar& bar,
                    double* X_bar) {
  for (Index f = 0; f < static_cast<Index>(topology.faces.size()); ++f) {
    face_vjp(topology, f, X, bar, X_bar);
  }
  bending_vjp(stencils, X, bar, X_bar);
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    for_each_rest_edge(topology, e, [&](Index v0, Index v1, double share) {
      const Vec3 bar_v1 = 2.0 * share * bar.edge_length_sq[e] * (row(X, v1) - row(X, v0));
      Eigen::Map<Vec3>(X_bar + 3 * v1) += bar_v1;
      Eigen::Map<Vec3>(X_bar + 3 * v0) -= bar_v1;
    });
  }
}

}  // namespace diffcloth::mesh
