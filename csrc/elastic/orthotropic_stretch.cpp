#include "elastic/orthotropic_stretch.h"

#include <algorithm>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::orthotropic {
namespace {

using Mat4 = Eigen::Matrix4d;

/// S = sqrt(C) in material axes; the area ratio is not floored here.
Mat2 root(const Mat32& F, const Frame& polar) {
  Mat2 S = F.transpose() * F;
  S.diagonal().array() += polar.d;
  return S / polar.t;
}

Mat2 strain(const Mat32& F, const Frame& polar) { return root(F, polar) - Mat2::Identity(); }

/// omega with S T - T S = omega J.
double commutator(const Mat2& S, const Mat2& T) {
  return S(0, 1) * (T(0, 0) - T(1, 1)) - T(0, 1) * (S(0, 0) - S(1, 1));
}

Mat2 quarter_turn() {
  Mat2 J;
  J << 0.0, -1.0, 1.0, 0.0;
  return J;
}

/// X with M X + X M = Y, for symmetric matrices: (Y + adj(M) Y adj(M) / det M) / (2 tr M).
Mat2 sylvester(const Mat2& M, const Mat2& Y) {
  const double t = M.trace();
  const Mat2 adjugate = t * Mat2::Identity() - M;
  return (Y + adjugate * Y * adjugate / M.determinant()) / (2.0 * t);
}

/// A triangle in material axes at one F.
struct State {
  Frame polar;
  Mat2 S;
  double omega;
  Mat2 B;       ///< R^T dE/dF
  Mat2 second;  ///< S^-1 B
};

State state_at(const Weave& weave, const Mat32& F) {
  State state;
  state.polar = frame(F);
  state.S = root(F, state.polar);
  const Mat2 T = weave.times(state.S - Mat2::Identity());
  state.omega = commutator(state.S, T);
  state.B = T + state.omega / state.polar.t * quarter_turn();
  state.second = symmetric_part(state.polar.S_inv * state.B);
  return state;
}

/// The in-plane part of R^T d(dE/dF) along the in-plane part K of R^T dF. With the rotation w of the
/// frame, dS = K - w J S and d(R B) = R (w J B + dB).
Mat2 in_plane_change(const Weave& weave, const State& state, const Mat2& K) {
  const double t = state.polar.t;
  const Mat2 J = quarter_turn();
  const double w = (K(1, 0) - K(0, 1)) / t;
  const Mat2 dS = symmetric_part(K - w * J * state.S);
  const Mat2 dT = weave.times(dS);
  const Mat2 T = state.B - state.omega / t * J;
  const double d_omega = commutator(dS, T) + commutator(state.S, dT);
  const double d_ratio = (d_omega - state.omega / t * dS.trace()) / t;
  return w * J * state.B + dT + d_ratio * J;
}

/// The form of the in-plane part: on the columns of K, one after the other.
Mat4 in_plane_form(const Weave& weave, const State& state) {
  Mat4 H;
  for (int k = 0; k < 4; ++k) {
    Mat2 K = Mat2::Zero();
    K(k % 2, k / 2) = 1.0;
    const Mat2 column = in_plane_change(weave, state, K);
    H.col(k) = Eigen::Map<const Vec4>(column.data());
  }
  return 0.5 * (H + H.transpose());
}

Mat4 clamped(const Mat4& H) {
  if (Eigen::LLT<Mat4>(H).info() == Eigen::Success) return H;
  const Eigen::SelfAdjointEigenSolver<Mat4> eigen(H);
  return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).asDiagonal() *
         eigen.eigenvectors().transpose();
}

}  // namespace

double energy(const Weave& weave, const Mat32& F_rest) {
  const Mat32 F = F_rest * weave.axes();
  const Mat2 e = strain(F, frame(F));
  return 0.5 * weave.times(e).cwiseProduct(e).sum();
}

double energy_change(const Weave& weave,
                     const Mat32& F0_rest,
                     const Mat32& F1_rest,
                     const Mat32& dF_rest) {
  const Mat2 Q = weave.axes();
  const Mat32 F0 = F0_rest * Q;
  const Mat32 F1 = F1_rest * Q;
  const Frame polar0 = frame(F0);
  const Frame polar1 = frame(F1);
  if (std::min(polar0.d, polar1.d) < kNearlyDegenerate) {
    return energy(weave, F1_rest) - energy(weave, F0_rest);
  }
  const Mat32 dF = dF_rest * Q;
  const Mat2 S0 = root(F0, polar0);
  const Mat2 S1 = root(F1, polar1);
  const Mat2 dC = symmetric_part(dF.transpose() * F1 + F0.transpose() * dF);
  const Mat2 dS = sylvester(S0 + S1, 2.0 * dC);
  const Mat2 twice_mean = (S0 - Mat2::Identity()) + (S1 - Mat2::Identity());
  return 0.5 * weave.times(twice_mean).cwiseProduct(dS).sum();
}

Mat32 stress(const Weave& weave, const Mat32& F_rest) {
  const Mat2 Q = weave.axes();
  const State state = state_at(weave, F_rest * Q);
  return state.polar.R.leftCols<2>() * state.B * Q.transpose();
}

Mat2 second_stress(const Weave& weave, const Mat32& F_rest) {
  const Mat2 Q = weave.axes();
  return Q * state_at(weave, F_rest * Q).second * Q.transpose();
}

Mat32 stress_change(const Weave& weave, const Mat32& F_rest, const Mat32& G_rest) {
  const Mat2 Q = weave.axes();
  const State state = state_at(weave, F_rest * Q);
  const Mat32 K = state.polar.R.transpose() * (G_rest * Q);
  Mat32 change;
  change.topRows<2>() = in_plane_change(weave, state, K.topRows<2>());
  change.row(2) = K.row(2) * state.second;
  return state.polar.R * change * Q.transpose();
}

// Corner q moves by v: R^T dF = (R^T v) g_q^T, whose columns are g_qd R^T v.
std::array<Mat3, 6> hessian(const Weave& weave,
                            const mesh::ShapeGradient& g_rest,
                            const Mat32& F_rest,
                            bool positive) {
  const Mat2 Q = weave.axes();
  const State state = state_at(weave, F_rest * Q);
  const mesh::ShapeGradient g = g_rest * Q;
  Mat4 in_plane = in_plane_form(weave, state);
  if (positive) in_plane = clamped(in_plane);
  const Mat2 second = positive ? positive_part(state.second) : state.second;
  const Mat32 R = state.polar.R.leftCols<2>();
  const Vec3 n = state.polar.R.col(2);
  const Mat3 nn = n * n.transpose();
  std::array<Mat3, 6> blocks;
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      Mat2 both = Mat2::Zero();
      for (int b = 0; b < 2; ++b) {
        for (int d = 0; d < 2; ++d) both += g(p, b) * g(q, d) * in_plane.block<2, 2>(2 * b, 2 * d);
      }
      blocks[k] = R * both * R.transpose() + g.row(p).dot(second * g.row(q).transpose()) * nn;
    }
  }
  return blocks;
}

}  // namespace diffcloth::elastic::orthotropic
