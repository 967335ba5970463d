#include "elastic/orthotropic_stretch.h"

#include "elastic/symmetric2.h"

namespace diffcloth::elastic::orthotropic {
namespace {

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

}  // namespace

double energy(const Weave& weave, const Mat32& F_rest) {
  const Mat32 F = F_rest * weave.axes();
  const Mat2 e = strain(F, frame(F));
  return 0.5 * weave.times(e).cwiseProduct(e).sum();
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

}  // namespace diffcloth::elastic::orthotropic
