#include "mesh/fit_operator.h"

#include <cmath>

namespace diffcloth::mesh {
namespace {

using Dual5 = Dual<5>;
using Dual8 = Dual<8>;

/// Singular values of a patch below this size count as zero.
constexpr double kRankFloor = 0.08;

/// The unknown of the fit is (x,uu ; sqrt2 x,uv ; x,vv), whose norm does not depend on the frame.
const Vec3 kUnknownScale(1.0, std::sqrt(0.5), 1.0);

// ---- the curvature operator of a patch ----

void patch_operator_vjp(const Chart& chart, const Operator& c_bar, ChartBar& bar) {
  const FitMatrix M = fit_matrix(chart);
  const double area = chart.area();
  const FitInverse inverse = fit_inverse(M, kRankFloor) / area;
  FitInverse inverse_bar = FitInverse::Zero(3, M.rows());
  std::array<Vec3, kMaxQuadratic> lambda_bar;
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
  const FitMatrix M_bar = fit_inverse_vjp(M, inverse_bar / area, kRankFloor);

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

Operator patch_operator_jvp(const Chart& chart, const ChartBar& dot) {
  const FitMatrix M = fit_matrix(chart);
  const double area = chart.area();
  const double area_dot = 0.5 * (dot.length * chart.base.b + chart.base.length * dot.b);
  std::array<FitRow<Dual<1>>, kMaxQuadratic> rows;
  FitMatrix M_dot = FitMatrix::Zero(M.rows(), 3);
  for (int j = 3; j < chart.size; ++j) {
    const std::array<double, 5> values = fit_parameters(chart, j);
    const std::array<double, 5> changes{dot.length, dot.a, dot.b, dot.u[j].x(), dot.u[j].y()};
    std::array<Dual<1>, 5> p;
    for (int k = 0; k < 5; ++k) {
      p[k] = {values[k], Eigen::Matrix<double, 1, 1>::Constant(changes[k])};
    }
    rows[j] = fit_row(p);
    for (int k = 0; k < 3; ++k) M_dot(j - 3, k) = rows[j].m[k].derivative(0);
  }
  const FitInverse inverse = fit_inverse(M, kRankFloor) / area;
  // The derivative of fit_inverse() is its own adjoint.
  FitInverse inverse_dot = fit_inverse_vjp(M, M_dot.transpose(), kRankFloor).transpose() / area;
  inverse_dot -= (area_dot / area) * inverse;

  Operator c_dot = Operator::Zero(3, chart.size);
  for (int j = 3; j < chart.size; ++j) {
    const Vec3 weight = kUnknownScale.cwiseProduct(inverse.col(j - 3));
    const Vec3 weight_dot = kUnknownScale.cwiseProduct(inverse_dot.col(j - 3));
    c_dot.col(j) = weight_dot;
    for (int i = 0; i < 3; ++i) {
      const Dual<1>& lambda = rows[j].lambda[i];
      c_dot.col(i) -= lambda.value * weight_dot + lambda.derivative(0) * weight;
    }
  }
  return c_dot;
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
  return {scale * (cot_bc + cot_bd), scale * (cot_ac + cot_ad), -(scale * (cot_ac + cot_bc)),
          -(scale * (cot_ad + cot_bd))};
}

/// Local vertices a, b, c, d of a hinge.
std::array<int, 4> hinge_corners(const BendingStencils& stencils, Index e) {
  const auto [a, b] = stencils.unfolding(e)[3].edge;
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

Operator hinge_operator_jvp(const Chart& chart,
                            const std::array<int, 4>& corner,
                            const ChartBar& dot) {
  const std::array<Dual8, 4> w = hinge_weights(variables<8>(hinge_coordinates(chart, corner)));
  Operator c_dot = Operator::Zero(3, 4);
  for (int i = 0; i < 4; ++i) {
    for (int k = 0; k < 4; ++k) {
      c_dot(0, corner[i]) += w[i].derivative.segment<2>(2 * k).dot(dot.u[corner[k]]);
    }
  }
  return c_dot;
}

}  // namespace

Operator patch_operator(const Chart& chart) {
  const FitInverse inverse = fit_inverse(fit_matrix(chart), kRankFloor) / chart.area();
  Operator c = Operator::Zero(3, chart.size);
  for (int j = 3; j < chart.size; ++j) {
    const Vec3 weight = kUnknownScale.cwiseProduct(inverse.col(j - 3));
    const FitRow<double> row = fit_row(fit_parameters(chart, j));
    c.col(j) = weight;
    for (int i = 0; i < 3; ++i) c.col(i) -= row.lambda[i] * weight;
  }
  return c;
}

Operator fit_operator(const BendingStencils& stencils, Index e, const Chart& chart) {
  switch (stencils.model[e]) {
    case BendingModel::kPatch:
      return patch_operator(chart);
    case BendingModel::kHinge:
      return hinge_operator(chart, hinge_corners(stencils, e));
  }
  return {};
}

void fit_operator_vjp(const BendingStencils& stencils,
                      Index e,
                      const Chart& chart,
                      const Operator& c_bar,
                      ChartBar& bar) {
  switch (stencils.model[e]) {
    case BendingModel::kPatch:
      return patch_operator_vjp(chart, c_bar, bar);
    case BendingModel::kHinge:
      return hinge_operator_vjp(chart, hinge_corners(stencils, e), c_bar, bar);
  }
}

Operator fit_operator_jvp(const BendingStencils& stencils,
                          Index e,
                          const Chart& chart,
                          const ChartBar& dot) {
  switch (stencils.model[e]) {
    case BendingModel::kPatch:
      return patch_operator_jvp(chart, dot);
    case BendingModel::kHinge:
      return hinge_operator_jvp(chart, hinge_corners(stencils, e), dot);
  }
  return {};
}

SideWeights side_weights(const Side<double>& side, const Operator& c) {
  SideWeights weights = c.transpose() * Eigen::Map<const Vec3>(side.k.data());
  for (int i = 0; i < 3; ++i) weights(i) += side.g[i];
  return weights;
}

}  // namespace diffcloth::mesh
