#include "mesh/side_derivative.h"

#include <array>
#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>

#include "common/dual.h"

namespace diffcloth::mesh {
namespace {

using Square = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMaxPoints, kMaxPoints>;
using Cubics = Eigen::Matrix<double, 4, Eigen::Dynamic, 0, 4, kMaxPoints>;
using Vec4 = Eigen::Vector4d;
using Mat2 = Eigen::Matrix2d;
using Dual1 = Dual<1>;
using Dual3 = Dual<3>;

/// Bounds on the singular values of the whitened quadratics, which are .5 to .7 on regular meshes:
/// values below kSideFloor count as zero, values from kDetermined on as determined.
constexpr double kSideFloor = 0.04;
constexpr double kDetermined = 0.12;
/// Largest |w| of a stencil without a second layer, see SideQuality.
constexpr double kModerate = 3.0;
/// Weight of |w| relative to the error of cubics. Three times this weight halves the largest eigenvalue
/// on meshes of slivers, and triples the error of waves.
constexpr double kRidge = 1e-2;
/// Size, relative to G, from which on least_hessian() treats a direction as determined.
constexpr double kKept = 1e-9;
/// Weight of an error of quadratics relative to an error of cubics.
constexpr double kQuadraticError = 1e4;

constexpr double kRoot2 = std::numbers::sqrt2;
constexpr double kRoot12 = 2.0 * std::numbers::sqrt3;

/// Scales of the points from C = sum_i (u_i - mean)(u_i - mean)^T, which is the unit matrix for the
/// coordinates B u.
template <class Scalar>
struct Metric {
  std::array<Scalar, 4> B;  ///< C^-1/2
  std::array<Scalar, 9>
      G;          ///< |f,uu|^2 + 2 |f,uv|^2 + |f,vv|^2 of (f,yy ; sqrt2 f,yz ; f,zz), y = B u
  Scalar length;  ///< square root of |C / count|: smooth also for round sets of points
};

/// @param C  uu, uv, vv
template <class Scalar>
Metric<Scalar> metric(const std::array<Scalar, 3>& C, int count) {
  using std::sqrt;
  const auto& [uu, uv, vv] = C;
  const Scalar det = uu * vv - uv * uv;
  const Scalar root = sqrt(det);
  // Cayley and Hamilton: C^1/2 = (C + root I) / trace(C^1/2).
  const Scalar scale = Scalar(1.0) / (sqrt(uu + vv + root + root) * root);
  const Scalar off = -(scale * uv);
  const Scalar p = vv / det, q = -uv / det, r = uu / det;  // C^-1
  const Scalar w(kRoot2);
  const Scalar pq = w * p * q, qr = w * q * r, qq = q * q;
  const Scalar size = sqrt(uu * uu + uv * uv + uv * uv + vv * vv);
  return {.B = {scale * (vv + root), off, off, scale * (uu + root)},
          .G = {p * p, pq, qq, pq, p * r + qq, qr, qq, qr, r * r},
          .length = sqrt(size / Scalar(count))};
}

/// Normal n of a side, and the mean over it of d/dn of the cubics below, in units of `length`.
template <class Scalar>
struct SideTarget {
  std::array<Scalar, 2> n;
  std::array<Scalar, 4> cubic;
};

/// @param p  half the side, and the length; the origin is its middle
template <class Scalar>
SideTarget<Scalar> side_target(const std::array<Scalar, 3>& p) {
  using std::sqrt;
  const auto& [hu, hv, length] = p;
  const Scalar size = sqrt(hu * hu + hv * hv);
  const Scalar nu = hv / size, nv = -(hu / size);
  const Scalar x = hu / length, y = hv / length;
  const Scalar third = Scalar(1.0 / 3.0) / length;  // the mean of t^2 over [-1, 1]
  const Scalar a = third * nu, b = third * nv;
  const Scalar pure(0.5), mixed(1.0 / kRoot12), two(2.0);
  return {.n = {nu, nv},
          .cubic = {pure * x * x * a, mixed * (two * x * y * a + x * x * b),
                    mixed * (y * y * a + two * x * y * b), pure * y * y * b}};
}

// Cubics u^a v^b / sqrt(3! a! b!): the sum of their squares does not depend on the frame.

Vec4 cubics(const Vec2& u) {
  const double x = u.x(), y = u.y();
  return {x * x * x / 6.0, x * x * y / kRoot12, x * y * y / kRoot12, y * y * y / 6.0};
}

Eigen::Matrix<double, 4, 2> cubics_gradient(const Vec2& u) {
  const double x = u.x(), y = u.y();
  Eigen::Matrix<double, 4, 2> g;
  g << 0.5 * x * x, 0.0, 2.0 * x * y / kRoot12, x * x / kRoot12, y * y / kRoot12,
      2.0 * x * y / kRoot12, 0.0, 0.5 * y * y;
  return g;
}

Vec3 quadratics(const Vec2& y) { return {y.x() * y.x(), kRoot2 * y.x() * y.y(), y.y() * y.y()}; }

Eigen::Matrix<double, 3, 2> quadratics_gradient(const Vec2& y) {
  Eigen::Matrix<double, 3, 2> g;
  g << 2.0 * y.x(), 0.0, kRoot2 * y.y(), kRoot2 * y.x(), 0.0, 2.0 * y.y();
  return g;
}

SidePoints centered(const SidePoints& x) { return x.rowwise() - x.colwise().mean(); }

Mat3 as_matrix(const std::array<double, 9>& G) { return Eigen::Map<const Mat3>(G.data()); }

/// Replaces the targets of quadratics that the points do not determine: among all targets that agree on
/// the points, selects the target with the least Hessian in the plane,
///
///   c = c2 - G D (D G D + kept ((1 + kKept) I - D^2))^-1 D^2 c2,   kept = kKept tr G,
///
/// with D the share of each direction that is lost. Otherwise a strip one triangle wide would be stiff.
struct LeastHessian {
  Mat3 G, D;
  Vec3 c2;
  double kept;
  Eigen::LDLT<Mat3> X;
  Vec3 p;  ///< X^-1 D^2 c2

  Mat3 rest() const { return (1.0 + kKept) * Mat3::Identity() - D * D; }
  Vec3 target() const { return c2 - G * (D * p); }

  struct Bars {
    Mat3 G, D;
    Vec3 c2;
  };
  Bars vjp(const Vec3& c_bar) const {
    const Vec3 q_bar = -(G * c_bar);  // q = D p
    const Vec3 s = X.solve(D * q_bar);
    const Mat3 X_bar = -s * p.transpose();
    const double kept_bar = X_bar.cwiseProduct(rest()).sum();
    return {.G = -c_bar * (D * p).transpose() + D * X_bar * D + kKept * kept_bar * Mat3::Identity(),
            .D = q_bar * p.transpose() + s * (D * c2).transpose() + (D * s) * c2.transpose() +
                 X_bar * (D * G) + (G * D) * X_bar - kept * (X_bar * D + D * X_bar),
            .c2 = c_bar + D * (D * s)};
  }

  Vec3 jvp(const Mat3& dG, const Mat3& dD, const Vec3& dc2) const {
    const Mat3 dDD = dD * D + D * dD;
    const Mat3 dX = dD * G * D + D * dG * D + D * G * dD + kKept * dG.trace() * rest() - kept * dDD;
    const Vec3 dp = X.solve(dDD * c2 + D * (D * dc2) - dX * p);
    return dc2 - dG * (D * p) - G * (dD * p + D * dp);
  }
};

LeastHessian least_hessian(const Mat3& G, const Mat3& D, const Vec3& c2) {
  LeastHessian result{.G = G, .D = D, .c2 = c2, .kept = kKept * G.trace(), .X = {}, .p = {}};
  result.X.compute(D * G * D + result.kept * result.rest());
  result.p = result.X.solve(D * (D * c2));
  return result;
}

/// All steps from the points to w.
///
/// With y = B x whitened, P0 the projector onto weights that annihilate affine functions, and F the
/// smooth inverse of A = P0 a, a the quadratics of y:
///
///   w0 = (y - mean) B n     affine functions exactly, the least |w|
///   z = w0 + F^T c          quadratics, c their targets after LeastHessian
///   w = z + P v             cubics: a Newton step of J(w) = (|K w - t|^2 + kRidge^2 |w|^2) / 2 among
///                           weights that change no quadratic, P = (P0 - A F)^2,
///
///   (P Q P + kRidge^2) v = P (K^T t - Q z),   Q = K^T K + kRidge^2.
struct SideFit {
  int count, a, b;
  SidePoints x, x_mean_free;  ///< relative to the middle of the side; to the mean
  Vec2 half;
  Metric<double> scales;
  SideTarget<double> target;
  Mat2 B;
  Vec2 n, ny;
  SidePoints y, y_mean_free;
  SideWeights w0;
  Square P0;
  FitMatrix quadratic, A;
  FitInverse F;
  LeastHessian least;
  Vec3 c;
  Square P1, P, Q;
  Cubics K;
  Vec4 t;
  SideWeights z, rest;  ///< rest = K^T t - Q z
  Eigen::LLT<Square> system;
  SideWeights v, w;

  explicit SideFit(const SideStencil& stencil)
      : count(static_cast<int>(stencil.u.rows())),
        a(stencil.a),
        b(stencil.b),
        x(stencil.u.rowwise() - 0.5 * (stencil.u.row(a) + stencil.u.row(b))),
        x_mean_free(centered(x)),
        half(0.5 * (stencil.u.row(b) - stencil.u.row(a)).transpose()),
        scales(metric(spread(), count)),
        target(side_target<double>({half.x(), half.y(), scales.length})),
        B(Eigen::Map<const Mat2>(scales.B.data())),
        n(target.n[0], target.n[1]),
        ny(B * n),
        y(x * B),
        y_mean_free(centered(y)),
        w0(y_mean_free * ny),
        P0(projector()),
        quadratic(quadratics_of_points()),
        A(P0 * quadratic),
        F(fit_inverse(A, kSideFloor)),
        least(least_hessian(
            as_matrix(scales.G), Mat3::Identity() - F * A, -(quadratic.transpose() * w0))),
        c(least.target()),
        P1(P0 - A * F),
        P(P1 * P1),
        K(cubics_of_points()),
        t(Eigen::Map<const Vec4>(target.cubic.data())) {
    Q = K.transpose() * K;
    Q.diagonal().array() += kRidge * kRidge;
    z = w0 + F.transpose() * c;
    rest = K.transpose() * t - Q * z;
    Square H = P * Q * P;
    H.diagonal().array() += kRidge * kRidge;
    system.compute(H);
    v = system.solve(P * rest);
    w = z + P * v;
  }

  std::array<double, 3> spread() const {
    const Mat2 C = x_mean_free.transpose() * x_mean_free;
    return {C(0, 0), C(0, 1), C(1, 1)};
  }

  Square projector() const {
    Square result = -(y_mean_free * y_mean_free.transpose());
    result.array() -= 1.0 / count;
    result.diagonal().array() += 1.0;
    return result;
  }

  FitMatrix quadratics_of_points() const {
    FitMatrix result(count, 3);
    const double scale = std::sqrt(count);  // makes singular values independent of the count
    for (int i = 0; i < count; ++i) {
      result.row(i) = scale * quadratics(y.row(i).transpose()).transpose();
    }
    return result;
  }

  Cubics cubics_of_points() const {
    Cubics result(4, count);
    for (int i = 0; i < count; ++i) result.col(i) = cubics(x.row(i).transpose() / scales.length);
    return result;
  }
};

}  // namespace

SideWeights side_derivative(const SideStencil& stencil) { return SideFit(stencil).w; }

// The pull back of SideFit, line by line in reverse.
SidePoints side_derivative_vjp(const SideStencil& stencil, const SideWeights& w_bar) {
  const SideFit fit(stencil);
  const int count = fit.count;
  const double length = fit.scales.length;

  // The Newton step. With s = P H^-1 P w_bar, the bar of Q is -s w^T.
  const SideWeights half_s = fit.system.solve(fit.P * w_bar);
  const SideWeights s = fit.P * half_s;
  const SideWeights z_bar = w_bar - fit.Q * s;
  const Cubics K_bar = (fit.t - fit.K * fit.w) * s.transpose() - (fit.K * s) * fit.w.transpose();
  const Vec4 t_bar = fit.K * s;
  const Square P_bar =
      z_bar * fit.v.transpose() + half_s * (fit.rest - fit.Q * (fit.P * fit.v)).transpose();
  const Square P1_bar = P_bar * fit.P1 + fit.P1 * P_bar;

  // Quadratics.
  const LeastHessian::Bars least = fit.least.vjp(fit.F * z_bar);
  const FitInverse F_bar =
      fit.c * z_bar.transpose() - fit.A.transpose() * P1_bar - least.D * fit.A.transpose();
  const FitMatrix A_bar = fit_inverse_vjp(fit.A, F_bar, kSideFloor) - P1_bar * fit.F.transpose() -
                          fit.F.transpose() * least.D;
  const FitMatrix quadratic_bar = fit.P0 * A_bar - fit.w0 * least.c2.transpose();
  const Square P0_bar = P1_bar + A_bar * fit.quadratic.transpose();

  // Affine functions.
  const SideWeights w0_bar = z_bar - fit.quadratic * least.c2;
  const Vec2 ny_bar = fit.y_mean_free.transpose() * w0_bar;
  const SidePoints y_mean_free_bar =
      w0_bar * fit.ny.transpose() - (P0_bar + P0_bar.transpose()) * fit.y_mean_free;

  // Points.
  SidePoints y_bar = centered(y_mean_free_bar);
  SidePoints x_bar(count, 2);
  double length_bar = 0.0;
  const double scale = std::sqrt(count);
  for (int i = 0; i < count; ++i) {
    y_bar.row(i) += scale * (quadratic_bar.row(i) * quadratics_gradient(fit.y.row(i).transpose()));
    const Vec2 u = fit.x.row(i).transpose() / length;
    const Vec2 u_bar = cubics_gradient(u).transpose() * K_bar.col(i);
    x_bar.row(i) = u_bar.transpose() / length;
    length_bar -= u_bar.dot(u) / length;
  }
  x_bar += y_bar * fit.B;
  const Mat2 B_bar = fit.x.transpose() * y_bar + ny_bar * fit.n.transpose();
  const Vec2 n_bar = fit.B * ny_bar;

  // The side.
  const SideTarget<Dual3> target = side_target(variables<3>({fit.half.x(), fit.half.y(), length}));
  Vec3 p_bar = Vec3::Zero();
  for (int k = 0; k < 2; ++k) p_bar += n_bar(k) * target.n[k].derivative;
  for (int k = 0; k < 4; ++k) p_bar += t_bar(k) * target.cubic[k].derivative;
  length_bar += p_bar(2);

  // The measures.
  const Metric<Dual3> scales = metric(variables<3>(fit.spread()), count);
  Vec3 C_bar = length_bar * scales.length.derivative;
  for (int k = 0; k < 4; ++k) C_bar += B_bar.data()[k] * scales.B[k].derivative;
  for (int k = 0; k < 9; ++k) C_bar += least.G.data()[k] * scales.G[k].derivative;
  Mat2 spread_bar;
  spread_bar << 2.0 * C_bar(0), C_bar(1), C_bar(1), 2.0 * C_bar(2);
  x_bar += fit.x_mean_free * spread_bar;

  SidePoints result = x_bar;
  const Vec2 middle_bar = -0.5 * x_bar.colwise().sum().transpose();
  const Vec2 half_bar = 0.5 * p_bar.head<2>();
  result.row(fit.a) += (middle_bar - half_bar).transpose();
  result.row(fit.b) += (middle_bar + half_bar).transpose();
  return result;
}

namespace {

template <std::size_t size>
std::array<Dual1, size> with_changes(const std::array<double, size>& values,
                                     const std::array<double, size>& changes) {
  std::array<Dual1, size> result;
  for (std::size_t k = 0; k < size; ++k) {
    result[k] = {values[k], Eigen::Matrix<double, 1, 1>::Constant(changes[k])};
  }
  return result;
}

template <class Result, std::size_t size>
Result derivatives(const std::array<Dual1, size>& numbers) {
  Result result;
  for (std::size_t k = 0; k < size; ++k) result.data()[k] = numbers[k].derivative(0);
  return result;
}

}  // namespace

SideWeights side_derivative_jvp(const SideStencil& stencil, const SidePoints& u_dot) {
  const SideFit fit(stencil);
  const int count = fit.count;
  const SidePoints x_dot = u_dot.rowwise() - 0.5 * (u_dot.row(fit.a) + u_dot.row(fit.b));
  const Vec2 half_dot = 0.5 * (u_dot.row(fit.b) - u_dot.row(fit.a)).transpose();

  const Mat2 one_sided = fit.x_mean_free.transpose() * x_dot;
  const Metric<Dual1> scales = metric(
      with_changes<3>(fit.spread(), {2.0 * one_sided(0, 0), one_sided(0, 1) + one_sided(1, 0),
                                     2.0 * one_sided(1, 1)}),
      count);
  const auto B_dot = derivatives<Mat2>(scales.B);
  const auto G_dot = derivatives<Mat3>(scales.G);
  const double length = fit.scales.length;
  const double length_dot = scales.length.derivative(0);
  const SideTarget<Dual1> target = side_target(with_changes<3>(
      {fit.half.x(), fit.half.y(), length}, {half_dot.x(), half_dot.y(), length_dot}));
  const auto n_dot = derivatives<Vec2>(target.n);
  const auto t_dot = derivatives<Vec4>(target.cubic);

  const SidePoints y_dot = x_dot * fit.B + fit.x * B_dot;
  const SidePoints y_mean_free_dot = centered(y_dot);
  const SideWeights w0_dot =
      y_mean_free_dot * fit.ny + fit.y_mean_free * (B_dot * fit.n + fit.B * n_dot);
  FitMatrix quadratic_dot(count, 3);
  Cubics K_dot(4, count);
  for (int i = 0; i < count; ++i) {
    const Vec2 u = fit.x.row(i).transpose() / length;
    const Vec2 change = (x_dot.row(i).transpose() - length_dot * u) / length;
    quadratic_dot.row(i) =
        std::sqrt(count) *
        (quadratics_gradient(fit.y.row(i).transpose()) * y_dot.row(i).transpose()).transpose();
    K_dot.col(i) = cubics_gradient(u) * change;
  }
  const Square one_sided_dot = -(y_mean_free_dot * fit.y_mean_free.transpose());
  const Square P0_dot = one_sided_dot + one_sided_dot.transpose();
  const FitMatrix A_dot = P0_dot * fit.quadratic + fit.P0 * quadratic_dot;
  // The derivative of fit_inverse() is its own adjoint.
  const FitInverse F_dot = fit_inverse_vjp(fit.A, A_dot.transpose(), kSideFloor).transpose();
  const Vec3 c_dot =
      fit.least.jvp(G_dot, -(F_dot * fit.A) - fit.F * A_dot,
                    -(quadratic_dot.transpose() * fit.w0) - fit.quadratic.transpose() * w0_dot);
  const SideWeights z_dot = w0_dot + F_dot.transpose() * fit.c + fit.F.transpose() * c_dot;

  const Square P1_dot = P0_dot - A_dot * fit.F - fit.A * F_dot;
  const Square P_dot = P1_dot * fit.P1 + fit.P1 * P1_dot;
  const SideWeights moved = z_dot + P_dot * fit.v;
  const SideWeights rest_dot = K_dot.transpose() * (fit.t - fit.K * fit.w) +
                               fit.K.transpose() * (t_dot - K_dot * fit.w) - fit.Q * moved;
  return moved +
         fit.P * fit.system.solve(P_dot * (fit.rest - fit.Q * (fit.P * fit.v)) + fit.P * rest_dot);
}

bool SideQuality::good() const { return determined == 3 && size <= kModerate; }

bool SideQuality::better_than(const SideQuality& other) const {
  if (determined != other.determined) return determined > other.determined;
  return determined == 3 ? size < other.size : error < other.error;
}

SideQuality side_quality(const SideStencil& stencil) {
  const SideFit fit(stencil);
  const Vec3 quadratic_error = fit.A.transpose() * (fit.w - fit.w0) - fit.c;
  return {.determined = static_cast<int>((singular_values(fit.A).array() >= kDetermined).count()),
          .size = fit.w.norm() / (std::sqrt(fit.count) * fit.ny.norm()),
          .error = kQuadraticError * quadratic_error.squaredNorm() +
                   (fit.K * fit.w - fit.t).squaredNorm() + kRidge * kRidge * fit.w.squaredNorm()};
}

}  // namespace diffcloth::mesh
