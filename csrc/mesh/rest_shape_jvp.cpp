// Forward derivatives: charts, operators of the quadratics, derivatives of the fitted sides, curvature.

#include <array>
#include <span>
#include <vector>

#include "mesh/quadratics.h"

namespace diffcloth::mesh {
namespace {

using Dual1 = Dual<1>;

Dual1 dual(double value, double change) {
  return {value, Eigen::Matrix<double, 1, 1>::Constant(change)};
}

double change_of(const Dual1& number) { return number.derivative(0); }

/// The coordinates of three rest vertices, with their changes.
std::array<Dual1, 9> dual_corners(const double* X,
                                  const double* X_dot,
                                  const std::array<Index, 3>& v) {
  const std::array<double, 9> values = corners(X, v);
  const std::array<double, 9> changes = corners(X_dot, v);
  std::array<Dual1, 9> result;
  for (int c = 0; c < 9; ++c) result[c] = dual(values[c], changes[c]);
  return result;
}

/// Change of a chart.
ChartBar chart_jvp(std::span<const Unfolding> points,
                   const Chart& chart,
                   const double* X,
                   const double* X_dot) {
  ChartBar dot;
  const BaseTriangle<Dual1> base = base_triangle(dual_corners(X, X_dot, points[0].rest));
  dot.length = change_of(base.length);
  dot.a = change_of(base.a);
  dot.b = change_of(base.b);
  for (int k = 0; k < 9; ++k) dot.frame[k] = change_of(base.frame[k]);
  dot.u[1] = Vec2(dot.length, 0.0);
  dot.u[2] = Vec2(dot.a, dot.b);
  for (int j = 3; j < chart.size; ++j) {
    const auto [a, b] = points[j].edge;
    const Foot<Dual1> foot = unfold(dual_corners(X, X_dot, points[j].rest));
    const Vec2 edge = chart.u[b] - chart.u[a];
    const Vec2 edge_dot = dot.u[b] - dot.u[a];
    const auto right = [](const Vec2& v) { return Vec2(v.y(), -v.x()); };
    dot.u[j] = dot.u[a] + change_of(foot.along) * edge + chart.foot[j].along * edge_dot +
               change_of(foot.off) * right(edge) + chart.foot[j].off * right(edge_dot);
  }
  return dot;
}

double area_change(const Chart& chart, const ChartBar& dot) {
  return 0.5 * (dot.length * chart.base.b + chart.base.length * dot.b);
}

std::array<Dual1, 3> dual_base(const Chart& chart, const ChartBar& dot) {
  return {dual(chart.base.length, dot.length), dual(chart.base.a, dot.a),
          dual(chart.base.b, dot.b)};
}

Vec3 changes(const std::array<Dual1, 3>& numbers) {
  return {change_of(numbers[0]), change_of(numbers[1]), change_of(numbers[2])};
}

/// Changes of Fits.
struct FitsChange {
  std::vector<ChartBar> chart;
  std::vector<Operator> c;
  std::vector<SideWeights> w;
};

FitsChange fits_jvp(const BendingStencils& stencils,
                    const Fits& fits,
                    const double* X,
                    const double* X_dot) {
  FitsChange dot;
  for (Index k = 0; k < stencils.chart_count(); ++k) {
    dot.chart.push_back(chart_jvp(stencils.unfolding(k), fits.chart[k], X, X_dot));
  }
  for (Index e = 0; e < stencils.size(); ++e) {
    dot.c.push_back(fit_operator_jvp(stencils, e, fits.chart[e], dot.chart[e]));
  }
  for (std::size_t s = 0; s < stencils.sides.size(); ++s) {
    const auto side = static_cast<Index>(s);
    const SideStencil stencil = fits.stencil(stencils, side);
    const ChartBar& chart_dot = dot.chart[stencils.side_chart(side)];
    SidePoints u_dot(stencil.u.rows(), 2);
    for (Index i = 0; i < u_dot.rows(); ++i) u_dot.row(i) = chart_dot.u[i].transpose();
    dot.w.push_back(side_derivative_jvp(stencil, u_dot));
  }
  return dot;
}

/// Change of curvature_operator().
std::vector<double> curvature_operator_jvp(const BendingStencils& stencils,
                                           const Fits& fits,
                                           const FitsChange& dot) {
  std::vector<double> result(3 * stencils.vertices.size(), 0.0);
  for (Index e = 0; e < stencils.size(); ++e) {
    element_columns(stencils, e, result).leftCols(dot.c[e].cols()) = dot.c[e];
  }
  for_each_element_side(stencils, [&](const ElementSide& part) {
    const Index e = part.element;
    OperatorMap c_dot = element_columns(stencils, e, result);
    const Side<Dual1> own = side(dual_base(fits.chart[e], dot.chart[e]), part.corner);
    const Side<double> value = side(base_parameters(fits.chart[e]), part.corner);
    const Eigen::Map<const Vec3> N(value.N.data());
    const Vec3 N_dot = changes(own.N);
    const SideWeights d = side_weights(value, fits.c[e]);
    SideWeights d_dot = dot.c[e].transpose() * Eigen::Map<const Vec3>(value.k.data()) +
                        fits.c[e].transpose() * changes(own.k);
    d_dot.head<3>() += changes(own.g);
    for (Index i = 0; i < d.size(); ++i) c_dot.col(i) -= d_dot(i) * N + d(i) * N_dot;
    const std::vector<Index> place = places(stencils, e, stencils.side_chart(part.side));
    for (std::size_t i = 0; i < place.size(); ++i) {
      const auto k = static_cast<Index>(i);
      c_dot.col(place[i]) += part.sign * (dot.w[part.side](k) * N + fits.w[part.side](k) * N_dot);
    }
  });
  return result;
}

void bending_jvp(const BendingStencils& stencils,
                 const double* X,
                 const double* X_dot,
                 RestShapeBar& dot) {
  const Fits fits(stencils, X);
  const FitsChange change = fits_jvp(stencils, fits, X, X_dot);
  const std::vector<double> c = curvature_operator(stencils, fits);
  dot.curvature_operator = curvature_operator_jvp(stencils, fits, change);
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::span<const Index> vertices = stencils.rest_element(e);
    const auto size = static_cast<Index>(vertices.size());
    const std::ptrdiff_t offset = 3 * static_cast<std::ptrdiff_t>(stencils.start[e]);
    const ConstOperatorMap c_e(c.data() + offset, 3, size);
    const ConstOperatorMap c_dot(dot.curvature_operator.data() + offset, 3, size);
    const Mat3 frame_dot = Eigen::Map<const Mat3>(change.chart[e].frame.data());
    const bool patch = stencils.model[e] == BendingModel::kPatch;
    dot.bending_area[e] = patch ? area_change(fits.chart[e], change.chart[e]) : 0.0;
    if (stencils.sewn[e] != 0) continue;
    dot.curvature[e] =
        frame_dot.transpose() * second_derivatives(vertices, c_e, X) +
        fits.chart[e].frame().transpose() *
            (second_derivatives(vertices, c_dot, X) + second_derivatives(vertices, c_e, X_dot));
  }
}

}  // namespace

RestShapeBar rest_shape_jvp(const Topology& topology,
                            const BendingStencils& stencils,
                            const double* X,
                            const double* X_dot) {
  RestShapeBar dot(topology, stencils);
  for (std::size_t f = 0; f < topology.faces.size(); ++f) {
    const std::array<Index, 3>& face = topology.faces[f];
    const std::array<Unfolding, 3> points = base_points(topology.rest_faces[f]);
    const Chart local = chart(points, X);
    const ChartBar change = chart_jvp(points, local, X, X_dot);
    const std::array<Dual1, 3> base = dual_base(local, change);
    const std::array<Dual1, 6> g = shape_gradient(base[0], base[1], base[2]);
    for (int k = 0; k < 6; ++k) dot.shape_gradient[f](k / 2, k % 2) = change_of(g[k]);
    dot.area[f] = area_change(local, change);
    for (int p = 0; p < 3; ++p) {
      dot.vertex_area[face[p]] += dot.area[f] / 3.0;
      dot.edge_area[topology.face_edges[f][p]] += dot.area[f] / 3.0;
    }
  }
  bending_jvp(stencils, X, X_dot, dot);
  for (std::size_t e = 0; e < topology.edges.size(); ++e) {
    for_each_rest_edge(topology, e, [&](Index v0, Index v1, double share) {
      dot.edge_length_sq[e] +=
          2.0 * share * (row(X, v1) - row(X, v0)).dot(row(X_dot, v1) - row(X_dot, v0));
    });
  }
  return dot;
}

}  // namespace diffcloth::mesh
