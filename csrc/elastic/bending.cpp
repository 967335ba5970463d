#include "elastic/bending.h"

#include <array>

#include "common/outer_product.h"
#include "elastic/damping.h"
#include "linalg/block_pattern.h"

namespace diffcloth::elastic::bending {
namespace {

/// Y_ab = sum_i c_ab,i x_i, one a column. The weights sum to zero: the common offset cancels first.
Mat3 second_derivatives(const Element& element, const double* x) {
  const Vec3 origin = row(x, element.vertices[0]);
  Mat3 Y = Mat3::Zero();
  for (Index i = 1; i < element.size(); ++i) {
    const Vec3 offset = row(x, element.vertices[i]) - origin;
    add_outer_product(offset, element.weights(i), Y);
  }
  return Y;
}

/// The second derivatives of x1 - x0.
Mat3 second_derivatives_change(const Element& element, const double* x0, const double* x1) {
  const Index v0 = element.vertices[0];
  const Vec3 origin = row(x1, v0) - row(x0, v0);
  Mat3 Y = Mat3::Zero();
  for (Index i = 1; i < element.size(); ++i) {
    const Index v = element.vertices[i];
    const Vec3 offset = row(x1, v) - row(x0, v) - origin;
    add_outer_product(offset, element.weights(i), Y);
  }
  return Y;
}

Mat32 base_gradient(const Element& element, const double* x) {
  return deformation_gradient(*element.g, row(x, element.vertices[0]), row(x, element.vertices[1]),
                              row(x, element.vertices[2]));
}

/// Element in its body frame at x: s and s_n, their work conjugates q = weight s Q, and the
/// generalized torque tau with dE = <q_total, R^T dY> - tau . w.
struct BodyState {
  Frame frame;
  Mat3 Q;          ///< weight times the quadratic form
  Mat3 curvature;  ///< R^T Y
  Mat3 q, q_n;     ///< q_n includes the damping factor
  Vec3 tau;

  Mat3 q_total() const { return q + q_n; }
};

BodyState body_state(const Element& element, const double* x) {
  BodyState state;
  state.frame = frame(base_gradient(element, x));
  state.Q = element.weight * element.form;
  state.curvature = state.frame.R.transpose() * second_derivatives(element, x);
  state.q = (state.curvature - *element.b) * state.Q;
  state.tau = sum_of_crosses(*element.b, state.q);
  state.q_n.setZero();
  if (element.damping != 0.0) {
    state.q_n = element.damping * (state.curvature - *element.b_n) * state.Q;
    state.tau += sum_of_crosses(*element.b_n, state.q_n);
  }
  return state;
}

/// Force on the frame: dE/dF = R V with V this 3x2 matrix.
Mat32 frame_stress(const BodyState& state) { return -rotation_adjoint(state.frame, state.tau); }

/// T - tr T I with T = sum_ab q_ab b_ab^T: -w_z^T (.) w_v is part of the second derivative.
Mat3 geometric_torque(const Element& element, const BodyState& state) {
  Mat3 T = state.q * element.b->transpose();
  if (element.damping != 0.0) T += state.q_n * element.b_n->transpose();
  T.diagonal().array() -= T.trace();
  return T;
}

/// Change of frame_stress() (in the fixed frame R) along K_v, without the contribution of the change of
/// q.
Mat32 frame_stress_geometric(const BodyState& state,
                             const Mat3& torque,
                             const Mat32& K_v,
                             const Vec3& w_v) {
  return -rotation_adjoint(state.frame, torque * w_v) -
         rotation_change_adjoint(state.frame, state.tau, K_v, w_v);
}

/// The derivative of an element's gradient along z.
struct BodyChange {
  Vec3 w;         ///< rotation of the frame
  Mat3 ds, ds_n;  ///< changes of s and s_n in the frame
  Mat3 dq, dq_n;
  Mat32 V;  ///< change of the force on the frame

  Mat3 dq_total() const { return dq + dq_n; }
};

BodyChange body_change(const Element& element, const BodyState& state, const double* z) {
  BodyChange change;
  const Mat3 Rt = state.frame.R.transpose();
  const Mat32 K = Rt * base_gradient(element, z);
  const Mat3 RtY = Rt * second_derivatives(element, z);
  change.w = rotation(state.frame, K);
  change.ds = RtY - cross_columns(change.w, *element.b);
  change.dq = change.ds * state.Q;
  Vec3 dtau = sum_of_crosses(*element.b, change.dq);
  change.ds_n.setZero();
  change.dq_n.setZero();
  if (element.damping != 0.0) {
    change.ds_n = RtY - cross_columns(change.w, *element.b_n);
    change.dq_n = element.damping * change.ds_n * state.Q;
    dtau += sum_of_crosses(*element.b_n, change.dq_n);
  }
  change.V = -rotation_adjoint(state.frame, dtau) +
             frame_stress_geometric(state, geometric_torque(element, state), K, change.w);
  return change;
}

/// y_i += Y_bar c_i over the element, y_p += F_bar g_p over its base triangle.
void scatter(const Element& element, const Mat3& Y_bar, const Mat32& F_bar, double* y) {
  for (Index i = 0; i < element.size(); ++i) {
    Eigen::Map<Vec3>(y + 3 * element.vertices[i]) += Y_bar * element.weights(i);
  }
  for (Index p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(y + 3 * element.vertices[p]) += F_bar * element.g->row(p).transpose();
  }
}

/// c_i += Y_bar^T x_i, g_p += F_bar^T x_p, with x relative to the first vertex (weights and gradients
/// sum to zero, so that an offset has no effect).
void scatter_geometry(const Element& element,
                      const Mat3& Y_bar,
                      const Mat32& F_bar,
                      const double* x,
                      const GeometryBars& bars) {
  const Vec3 origin = row(x, element.vertices[0]);
  for (Index i = 0; i < element.size(); ++i) {
    const Vec3 side = row(x, element.vertices[i]) - origin;
    Eigen::Map<Vec3>(bars.c + 3 * i) += Y_bar.transpose() * side;
    if (i < 3) bars.g->row(i) += (F_bar.transpose() * side).transpose();
  }
}

}  // namespace

Mat3 body_curvature(const Element& element, const double* x) {
  return frame(base_gradient(element, x)).R.transpose() * second_derivatives(element, x);
}

namespace {

/// Visit the positions on which start_curvature() depends, with the share of their curvature.
template <class Visit>
void for_each_share(const Start& start, const Visit& visit) {
  if (start.ahead == nullptr) return visit(start.x_n, 1.0);
  visit(start.x_n, 1.0 + damping::kAhead);
  visit(start.ahead, -damping::kAhead);
}

}  // namespace

Mat3 start_curvature(const Element& element, const Start& start) {
  if (start.ahead == nullptr) return body_curvature(element, start.x_n);
  Mat3 sum = Mat3::Zero();
  for_each_share(start,
                 [&](const double* x, double share) { sum += share * body_curvature(element, x); });
  return sum;
}

double energy(const Element& element, const double* x) {
  const Mat3 s =
      element.flat ? second_derivatives(element, x) : Mat3(body_curvature(element, x) - *element.b);
  return 0.5 * element.weight * (s * element.form).cwiseProduct(s).sum();
}

double flat_energy_change(const Element& element, const double* x0, const double* x1) {
  const Mat3 Y0 = second_derivatives(element, x0);
  const Mat3 dY = second_derivatives_change(element, x0, x1);
  return 0.5 * element.weight * ((2.0 * Y0 + dY) * element.form).cwiseProduct(dY).sum();
}

void add_flat_gradient(const Element& element, const double* x, double* g) {
  const Mat3 q = second_derivatives(element, x) * (element.weight * element.form);
  for (Index i = 0; i < element.size(); ++i) {
    Eigen::Map<Vec3>(g + 3 * element.vertices[i]) += q * element.weights(i);
  }
}

void add_constant(const Element& element, std::span<const Index> slots, double* constant) {
  const Mat3 Q = element.weight * element.form;
  for (Index i = 0; i < element.size(); ++i) {
    const Vec3 Qc = Q * element.weights(i);
    for (Index j = 0; j <= i; ++j) {
      constant[slots[linalg::lower(i, j)]] += Qc.dot(element.weights(j));
    }
  }
}

void add_hessian_product(const Element& element, const double* x, const double* z, double* y) {
  if (element.flat) {
    add_flat_gradient(element, z, y);  // linear
    return;
  }
  const BodyState state = body_state(element, x);
  const BodyChange change = body_change(element, state, z);
  const Mat3& R = state.frame.R;
  scatter(element, R * change.dq_total(), R * change.V, y);
}

ScalarBars constant_mixed(const Element& element,
                          FormDerivatives derivatives,
                          const double* u,
                          const double* z,
                          double* c_bar) {
  const Mat3 Y_u = second_derivatives(element, u);
  const Mat3 Y_z = second_derivatives(element, z);
  const Mat3& Q = element.form;
  if (c_bar != nullptr) {
    const Index v0 = element.vertices[0];
    const Mat3 q_u = element.weight * Q * Y_u.transpose();
    const Mat3 q_z = element.weight * Q * Y_z.transpose();
    for (Index i = 1; i < element.size(); ++i) {
      const Index v = element.vertices[i];
      Eigen::Map<Vec3>(c_bar + 3 * i) +=
          q_u * (row(z, v) - row(z, v0)) + q_z * (row(u, v) - row(u, v0));
    }
  }
  ScalarBars result;
  result.weight = (Y_u * Q).cwiseProduct(Y_z).sum();
  for (std::size_t k = 0; k < derivatives.size(); ++k) {
    result.form[k] = element.weight * (Y_u * derivatives[k]).cwiseProduct(Y_z).sum();
  }
  return result;
}

// By body_state(), d phi = <q, R^T dY - db> - tau . w. If b = 0, the frame drops out, as in energy(),
// but not from the derivative by b.
ScalarBars energy_bars(Element element,
                       FormDerivatives derivatives,
                       const double* x,
                       double seed,
                       const GeometryBars& bars,
                       double* x_bar) {
  element.weight *= seed;
  element.damping = 0.0;
  const BodyState state = body_state(element, x);
  const Mat3& R = state.frame.R;
  const Mat3 s = element.flat ? second_derivatives(element, x) : Mat3(state.curvature - *element.b);
  const Mat3 Y_bar = element.flat ? Mat3(s * state.Q) : Mat3(R * state.q);
  const Mat32 F_bar = R * frame_stress(state);
  scatter(element, Y_bar, F_bar, x_bar);
  if (bars.c != nullptr) {
    *bars.b -= state.q;
    scatter_geometry(element, Y_bar, F_bar, x, bars);
  }
  ScalarBars result;
  result.weight = 0.5 * seed * (s * element.form).cwiseProduct(s).sum();
  for (std::size_t k = 0; k < derivatives.size(); ++k) {
    result.form[k] = 0.5 * element.weight * (s * derivatives[k]).cwiseProduct(s).sum();
  }
  return result;
}

// phi = z . grad E = weight [ <s Q, ds> + damping <s_n Q, ds_n> ] with ds the change of s along z:
// ds = R^T Y(z) - w x b. By symmetry of second derivatives, the gradient of phi with respect to (Y, F)
// is the change of (dE/dY, dE/dF) along z, and the gradient with respect to (Y(z), F(z)) is (dE/dY,
// dE/dF). The terms that depend on b: db -> -dq . db + (w x q) . db.
ScalarBars mixed(const Element& element,
                 FormDerivatives derivatives,
                 const double* x,
                 const Start& start,
                 const double* z,
                 const GeometryBars& bars) {
  const bool with_rest = bars.c != nullptr;
  if (element.flat && start.x_n == nullptr && !with_rest) {
    return constant_mixed(element, derivatives, x, z, nullptr);
  }
  const BodyState state = body_state(element, x);
  const BodyChange change = body_change(element, state, z);
  const Mat3& R = state.frame.R;

  const Mat3& Q = element.form;
  const Mat3 s = state.curvature - *element.b;
  ScalarBars result;
  result.weight = (s * Q).cwiseProduct(change.ds).sum();
  for (std::size_t k = 0; k < derivatives.size(); ++k) {
    result.form[k] = element.weight * (s * derivatives[k]).cwiseProduct(change.ds).sum();
  }
  if (start.x_n != nullptr) {
    // Also if the damping is zero, as its derivative is not.
    const Mat3 s_n = state.curvature - *element.b_n;
    const Mat3 ds_n = change.ds + cross_columns(change.w, *element.b - *element.b_n);
    const double work_n = (s_n * Q).cwiseProduct(ds_n).sum();
    result.weight += element.damping * work_n;
    for (std::size_t k = 0; k < derivatives.size(); ++k) {
      const double work = (s_n * derivatives[k]).cwiseProduct(ds_n).sum();
      result.form[k] += element.weight * element.damping * work;
    }
    result.damping = element.weight * work_n;
  }

  if (with_rest) {
    *bars.b += cross_columns(change.w, state.q) - change.dq;
    scatter_geometry(element, R * change.dq_total(), R * change.V, x, bars);
    scatter_geometry(element, R * state.q_total(), R * frame_stress(state), z, bars);
  }
  if (element.damping != 0.0 && start.x_n != nullptr) {
    const Mat3 b_bar = cross_columns(change.w, state.q_n) - change.dq_n;
    for_each_share(start, [&](const double* at, double share) {
      // b = R^T Y
      const Frame there = frame(base_gradient(element, at));
      const Mat3 b = body_curvature(element, at);
      const Mat3 Y_bar = there.R * (share * b_bar);
      const Mat32 F_bar = -there.R * rotation_adjoint(there, sum_of_crosses(b, share * b_bar));
      scatter(element, Y_bar, F_bar, at == start.x_n ? bars.x_n : bars.ahead);
      if (with_rest) scatter_geometry(element, Y_bar, F_bar, at, bars);
    });
  }
  return result;
}

namespace {

/// The change of start_curvature().
Mat3 start_curvature_change(const Element& element,
                            const Element& moved,
                            const Start& start,
                            const Tangents& dot) {
  Mat3 change = Mat3::Zero();
  for_each_share(start, [&](const double* at, double share) {
    const Frame there = frame(base_gradient(element, at));
    const Mat3 Rt = there.R.transpose();
    Mat3 Y_dot = Mat3::Zero();
    Mat32 F_dot = Mat32::Zero();
    if (const double* const at_dot = at == start.x_n ? dot.x_n : dot.ahead; at_dot != nullptr) {
      Y_dot += second_derivatives(element, at_dot);
      F_dot += base_gradient(element, at_dot);
    }
    if (dot.c != nullptr) {
      Y_dot += second_derivatives(moved, at);
      F_dot += base_gradient(moved, at);
    }
    const Mat3 b = body_curvature(element, at);
    change += share * (Rt * Y_dot - cross_columns(rotation(there, Rt * F_dot), b));
  });
  return change;
}

}  // namespace

void add_constant_tangent(const Element& element, const double* u, const Tangents& dot, double* y) {
  const Mat3 Q = element.weight * element.form;
  const Mat3 dQ = dot.weight * element.form + element.weight * dot.form;
  const Mat3 Y = second_derivatives(element, u);
  Mat3 dq = Y * dQ;
  Element moved = element;
  if (dot.c != nullptr) {
    moved.c = dot.c;
    dq += second_derivatives(moved, u) * Q;
  }
  for (Index i = 0; i < element.size(); ++i) {
    Eigen::Map<Vec3> y_i(y + 3 * element.vertices[i]);
    y_i += dq * element.weights(i);
    if (dot.c != nullptr) y_i += Y * (Q * moved.weights(i));
  }
}

// As in body_change(), with the changes of c and g instead of the changes of x, and additionally the
// changes of b, b_n and Q.
void add_tangent(
    const Element& element, const double* x, const Start& start, const Tangents& dot, double* y) {
  const bool with_rest = dot.c != nullptr;
  const Mat3 dQ = dot.weight * element.form + element.weight * dot.form;
  if (element.flat && !with_rest && dot.damping == 0.0) {
    const Mat3 q = second_derivatives(element, x) * dQ;
    for (Index i = 0; i < element.size(); ++i) {
      Eigen::Map<Vec3>(y + 3 * element.vertices[i]) += q * element.weights(i);
    }
    return;
  }
  const BodyState state = body_state(element, x);
  const Mat3& R = state.frame.R;
  Element moved = element;  // with the changes of c and g in their places
  Mat3 RtY = Mat3::Zero();
  Mat32 K = Mat32::Zero();
  Mat3 db = Mat3::Zero();
  if (with_rest) {
    moved.c = dot.c;
    moved.g = dot.g;
    RtY = R.transpose() * second_derivatives(moved, x);
    K = R.transpose() * base_gradient(moved, x);
    db = *dot.b;
  }
  const Vec3 w = rotation(state.frame, K);
  const Mat3 ds = RtY - cross_columns(w, *element.b) - db;
  Mat3 dq = ds * state.Q + (state.curvature - *element.b) * dQ;
  Vec3 dtau = sum_of_crosses(*element.b, dq) + sum_of_crosses(db, state.q);
  if (start.x_n != nullptr && (element.damping != 0.0 || dot.damping != 0.0)) {
    const Mat3& b_n = *element.b_n;
    const Mat3 db_n = start_curvature_change(element, moved, start, dot);
    const Mat3 s_n = state.curvature - b_n;
    const Mat3 ds_n = RtY - cross_columns(w, b_n) - db_n;
    const Mat3 dq_n = element.damping * (ds_n * state.Q + s_n * dQ) + dot.damping * (s_n * state.Q);
    dtau += sum_of_crosses(b_n, dq_n) + sum_of_crosses(db_n, state.q_n);
    dq += dq_n;
  }
  const Mat32 V = -rotation_adjoint(state.frame, dtau) +
                  frame_stress_geometric(state, geometric_torque(element, state), K, w);
  scatter(element, R * dq, R * V, y);
  if (with_rest) scatter(moved, R * state.q_total(), R * frame_stress(state), y);
}

}  // namespace diffcloth::elastic::bending
