#include "contact/distance/closest.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <Eigen/Geometry>

namespace diffcloth::contact {
namespace {

/// Relative |u x v|^2 below which directions count as parallel: the square of 1.6e-8, at which the cross
/// product of double coordinates still has half of its digits.
constexpr double kParallel = 2.5e-16;

/// Distance from a vertex to an edge, as found while classifying.
struct Nearest {
  int vertex;  ///< corner index of the point; its sign depends on the primitive it belongs to
  int e0, e1;  ///< corners of the edge
  double a;    ///< parameter on the edge, clamped to [0, 1]
  double d_sq = std::numeric_limits<double>::infinity();
};

Nearest point_edge(const Corners& x, int vertex, int e0, int e1) {
  const Vec3 e = x[e1] - x[e0];
  const Vec3 w = x[vertex] - x[e0];
  const double ee = e.squaredNorm();
  const double we = w.dot(e);
  // An edge of no length is its first vertex.
  const double a = we <= 0 || ee == 0 ? 0.0 : (we >= ee ? 1.0 : we / ee);
  const double d_sq = a == 1 ? (x[vertex] - x[e1]).squaredNorm() : (w - a * e).squaredNorm();
  return {.vertex = vertex, .e0 = e0, .e1 = e1, .a = a, .d_sq = d_sq};
}

Closest empty() {
  return {.c = Vec4::Zero(),
          .parameter_count = 0,
          .c_beta = Eigen::Matrix<double, 4, 2>::Zero(),
          .s = Eigen::Matrix<double, 3, 2>::Zero(),
          .M_inv = Mat2::Zero(),
          .t = Vec3::Zero(),
          .d_sq = 0};
}

/// Point-edge and point-point. `sign` is +1 if the vertex belongs to the first primitive.
Closest from_point_edge(const Corners& x, const Nearest& nearest, double sign) {
  Closest out = empty();
  const auto& [vertex, e0, e1, a, d_sq] = nearest;
  out.c[vertex] = sign;
  if (a == 0 || a == 1) {
    const int other = a == 0 ? e0 : e1;
    out.c[other] = -sign;
    out.t = sign * (x[vertex] - x[other]);
  } else {
    const Vec3 e = x[e1] - x[e0];
    out.c[e0] = -sign * (1 - a);
    out.c[e1] = -sign * a;
    out.parameter_count = 1;
    out.c_beta(e0, 0) = sign;
    out.c_beta(e1, 0) = -sign;
    out.s.col(0) = -sign * e;
    out.M_inv(0, 0) = 1 / e.squaredNorm();
    out.t = sign * ((x[vertex] - x[e0]) - a * e);
  }
  out.d_sq = out.t.squaredNorm();
  return out;
}

/// Inverse of M = [s0.s0, s0.s1; s0.s1, s1.s1], whose determinant is |s0 x s1|^2.
Mat2 inverse_metric(const Vec3& s0, const Vec3& s1, double determinant) {
  const double off = -s0.dot(s1);
  Mat2 M_inv;
  M_inv << s1.squaredNorm(), off, off, s0.squaredNorm();
  return M_inv / determinant;
}

/// Tolerance outside a triangle, in barycentric parameters, within which a point still projects onto it:
/// the rounding error of the parameters. The distance is not affected.
double border(const Vec3& e0, const Vec3& e1, const Vec3& w, double n_sq) {
  constexpr double kBorder = 2e-12;
  const double longest_sq = std::max(e0.squaredNorm(), e1.squaredNorm());
  return kBorder * std::sqrt(std::max(1.0, longest_sq * w.squaredNorm() / n_sq));
}

Nearest nearer(const Nearest& p, const Nearest& q) { return q.d_sq < p.d_sq ? q : p; }

/// Closest points inside a triangle, or inside both of two edges.
struct Inner {
  Vec3 s0, s1;  ///< the two edges
  double n_sq;  ///< |s0 x s1|^2
  double a, b;  ///< the parameters
  Vec3 t;
};

bool find_in_triangle(const Corners& x, Inner& out) {
  const Vec3 e0 = x[2] - x[1];
  const Vec3 e1 = x[3] - x[1];
  const Vec3 w = x[0] - x[1];
  const Vec3 n = e0.cross(e1);
  const double n_sq = n.squaredNorm();
  if (!(n_sq > kParallel * e0.squaredNorm() * e1.squaredNorm())) return false;
  const double b0 = w.cross(e1).dot(n) / n_sq;
  const double b1 = e0.cross(w).dot(n) / n_sq;
  if (!(std::min({b0, b1, 1 - b0 - b1}) > -border(e0, e1, w, n_sq))) return false;
  out = {.s0 = e0, .s1 = e1, .n_sq = n_sq, .a = b0, .b = b1, .t = w - b0 * e0 - b1 * e1};
  return true;
}

bool find_between_edges(const Corners& x, Inner& out) {
  const Vec3 u = x[1] - x[0];
  const Vec3 v = x[3] - x[2];
  const Vec3 w = x[0] - x[2];
  const Vec3 n = u.cross(v);
  const double n_sq = n.squaredNorm();
  if (!(n_sq >= kParallel * u.squaredNorm() * v.squaredNorm() && n_sq > 0)) return false;
  const double s = v.cross(w).dot(n) / n_sq;
  const double t = u.cross(w).dot(n) / n_sq;
  if (!(s > 0 && s < 1 && t > 0 && t < 1)) return false;
  out = {.s0 = u, .s1 = v, .n_sq = n_sq, .a = s, .b = t, .t = w + s * u - t * v};
  return true;
}

Vec4 triangle_weights(const Inner& in) { return {1, -(1 - in.a - in.b), -in.a, -in.b}; }
Vec4 edge_weights(const Inner& in) { return {1 - in.a, in.a, -(1 - in.b), -in.b}; }

Nearest nearest_side(const Corners& x) {
  const Nearest e01 = point_edge(x, 0, 1, 2);
  const Nearest e12 = point_edge(x, 0, 2, 3);
  const Nearest e20 = point_edge(x, 0, 3, 1);
  return nearer(nearer(e01, e12), e20);
}

Nearest nearest_end(const Corners& x) {
  const Nearest a0 = point_edge(x, 0, 2, 3);
  const Nearest a1 = point_edge(x, 1, 2, 3);
  const Nearest b0 = point_edge(x, 2, 0, 1);
  const Nearest b1 = point_edge(x, 3, 0, 1);
  return nearer(nearer(a0, a1), nearer(b0, b1));
}

/// +1 if the vertex belongs to the first primitive, else -1.
double sign_of(PairKind kind, const Nearest& nearest) {
  return kind == PairKind::kPointTriangle || nearest.vertex < 2 ? 1.0 : -1.0;
}

Closest point_triangle(const Corners& x) {
  Inner in;
  if (!find_in_triangle(x, in)) {
    return from_point_edge(x, nearest_side(x), 1);
  }
  Closest out = empty();
  out.c = triangle_weights(in);
  out.parameter_count = 2;
  out.c_beta.col(0) << 0, 1, -1, 0;
  out.c_beta.col(1) << 0, 1, 0, -1;
  out.s.col(0) = -in.s0;
  out.s.col(1) = -in.s1;
  out.M_inv = inverse_metric(in.s0, in.s1, in.n_sq);
  out.t = in.t;
  out.d_sq = out.t.squaredNorm();
  return out;
}

Closest edge_edge(const Corners& x) {
  Inner in;
  if (!find_between_edges(x, in)) {
    const Nearest nearest = nearest_end(x);
    return from_point_edge(x, nearest, sign_of(PairKind::kEdgeEdge, nearest));
  }
  Closest out = empty();
  out.c = edge_weights(in);
  out.parameter_count = 2;
  out.c_beta.col(0) << -1, 1, 0, 0;
  out.c_beta.col(1) << 0, 0, 1, -1;
  out.s.col(0) = in.s0;
  out.s.col(1) = -in.s1;
  out.M_inv = inverse_metric(in.s0, -in.s1, in.n_sq);
  out.t = in.t;
  out.d_sq = out.t.squaredNorm();
  return out;
}

/// G = d(s . t)/dx: rows (3 i .. 3 i + 2) of column a are c_i s_a + c'_(a,i) t.
Eigen::Matrix<double, 12, 2> parameter_coupling(const Closest& pair) {
  Eigen::Matrix<double, 12, 2> G;
  for (int a = 0; a < 2; ++a) {
    for (int i = 0; i < 4; ++i) {
      G.block<3, 1>(3 * i, a) = pair.c[i] * pair.s.col(a) + pair.c_beta(i, a) * pair.t;
    }
  }
  return G;
}

}  // namespace

Closest closest(PairKind kind, const Corners& x) {
  switch (kind) {
    case PairKind::kPointTriangle:
      return point_triangle(x);
    case PairKind::kEdgeEdge:
      return edge_edge(x);
  }
  __builtin_unreachable();
}

ClosestPoints closest_points(PairKind kind, const Corners& x) {
  const bool is_face = kind == PairKind::kPointTriangle;
  Inner in;
  if (is_face ? find_in_triangle(x, in) : find_between_edges(x, in)) {
    return {.c = is_face ? triangle_weights(in) : edge_weights(in),
            .parameter_count = 2,
            .d_sq = in.t.squaredNorm()};
  }
  const Nearest nearest = is_face ? nearest_side(x) : nearest_end(x);
  const double sign = sign_of(kind, nearest);
  ClosestPoints out{.c = Vec4::Zero(), .parameter_count = 0, .d_sq = nearest.d_sq};
  out.c[nearest.vertex] = sign;
  if (nearest.a == 0 || nearest.a == 1) {
    out.c[nearest.a == 0 ? nearest.e0 : nearest.e1] = -sign;
  } else {
    out.c[nearest.e0] = -sign * (1 - nearest.a);
    out.c[nearest.e1] = -sign * nearest.a;
    out.parameter_count = 1;
  }
  return out;
}

Vec12 distance_sq_gradient(const Closest& pair) {
  Vec12 gradient;
  for (int i = 0; i < 4; ++i) gradient.segment<3>(3 * i) = 2 * pair.c[i] * pair.t;
  return gradient;
}

Sliding sliding(const Closest& pair) {
  const Eigen::Matrix<double, 12, 2> G = parameter_coupling(pair);
  return {.left = -2 * G * pair.M_inv, .right = G};
}

Mat12 distance_sq_hessian(const Closest& pair) {
  Mat12 hessian = Mat12::Zero();
  if (pair.parameter_count > 0) {
    const Sliding part = sliding(pair);
    hessian = part.left.lazyProduct(part.right.transpose());  // unrolled, a product would call gemm
  }
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 4; ++j) {
      hessian.block<3, 3>(3 * i, 3 * j).diagonal().array() += 2 * pair.c[i] * pair.c[j];
    }
  }
  return hessian;
}

Eigen::Matrix<double, 2, 12> beta_jacobian(const Closest& pair) {
  return -pair.M_inv * parameter_coupling(pair).transpose();
}

}  // namespace diffcloth::contact
