// Tangent of the gradient of lagged friction by its inputs besides x, in the notation of friction_set.h:
//
//   grad D = mu lambda q B^T w,   q = f1/|w|,   w = P s,   s = r(x) - E(x) a - E_L b,
//   a = E_L^-1 share t,   b = E(x_start)^-1 share r',   r' = r(x_start) + l n,   for each part.
//
// Factors of a contact that are common to all directions are computed once; the rest processes
// directions side by side: see direction_lanes_impl.h.

#include <array>
#include <cmath>
#include <vector>

#include "contact/direction_lanes.h"
#include "contact/distance/mollifier.h"
#include "contact/friction_set.h"

namespace diffcloth::contact {
namespace {

using Entry = FrictionSet::Entry;
using Frame = FrictionSet::Frame;
using GapPart = FrictionSet::GapPart;

/// Derivative of the normal force,  lambda = -2 d kappa w m b'(D).
class NormalForceDerivative {
 public:
  NormalForceDerivative(const Contact& lag, const Vec12& d_sq_gradient, const double* x_lag)
      : lag_(lag), d_(std::sqrt(lag.closest.d_sq)) {
    const double scale = lag.kappa * lag.weight;
    const double m = lag.mollifier;
    const double b1 = lag.barrier.b1;
    by_corners = (-scale * m * (2.0 * d_ * lag.barrier.b2 + b1 / d_)) * d_sq_gradient;
    if (!lag.mollified) return;
    const Mollifier by = mollifier_derivatives(corners(lag.pair.vertices, x_lag), lag.threshold);
    by_corners -= (2.0 * d_ * scale * b1) * by.gradient;
    m_eps_ = by.m_eps;
  }

  Vec12 by_corners;

  double by_parameters(const ContactModel::ContactTangent& dot, double d_hat_dot) const {
    const Barrier& b = lag_.barrier;
    const double scale = lag_.kappa * lag_.weight;
    const double scale_dot = dot.kappa * lag_.weight + lag_.kappa * dot.weight;
    const double b1_dot = b.b1_d_hat * d_hat_dot + b.b1_xi * dot.xi;
    const double m = lag_.mollifier;
    return -2.0 * d_ *
           (scale_dot * m * b.b1 + scale * (m_eps_ * dot.threshold * b.b1 + m * b1_dot));
  }

 private:
  const Contact& lag_;
  double d_;
  double m_eps_ = 0.0;
};

void copy(const Vec3& from, double* to) { Eigen::Map<Vec3>{to} = from; }

/// Fill in the derivatives through sliding of the closest points of the lag configuration.
void fill_sliding(const Entry& k, const double* x, const double* x_start, FrictionTangent& out) {
  const Closest& geometry = k.lag.closest;
  Eigen::Matrix<double, 2, 12> beta = beta_jacobian(geometry);
  if (geometry.parameter_count == 1) beta.row(1).setZero();
  Eigen::Matrix<double, 3, 4> corners;
  Eigen::Matrix<double, 3, 4> corners_start;
  const auto& v = k.lag.pair.vertices;
  for (int i = 0; i < 4; ++i) {
    corners.col(i) = row(x, v[i]) - row(x, v[0]);
    corners_start.col(i) = row(x_start, v[i]) - row(x_start, v[0]);
  }
  const Eigen::Matrix<double, 3, 2> moved = corners.lazyProduct(geometry.c_beta);
  const Eigen::Matrix<double, 3, 2> moved_start = corners_start.lazyProduct(geometry.c_beta);
  for (int b = 0; b < 2; ++b) {
    for (int a = 0; a < 12; ++a) out.beta[b][a] = beta(b, a);
    for (int i = 0; i < 4; ++i) out.c_beta[i][b] = geometry.c_beta(i, b);
    for (int a = 0; a < 3; ++a) {
      out.t_beta[a][b] = geometry.s(a, b);
      out.r_beta[a][b] = moved(a, b);
      out.r_start_beta[a][b] = moved_start(a, b);
    }
  }
}

/// Fill in the derivatives through the frame of a part, at the lag configuration and at the start.
void fill_part(const Entry& k,
               const FrictionSet::GapPart& part,
               const Frame& frame,
               const Vec3& force,
               const double* x_start,
               const double* x_lag,
               FrameTangent& out) {
  out.edge = part.edges.data();
  out.turns = part.turns;
  out.share = part.share;
  if (!part.turns) return;
  const Frame start(k, part, x_start);
  const Frame lag(k, part, x_lag);
  for (int b = 0; b < 3; ++b) {
    copy(part.turn.row(b), out.turn[b]);
  }
  const double m_sq = lag.m.squaredNorm();
  copy(lag.e2.cross(lag.m) / m_sq, out.to_lag[0]);
  copy(lag.m.cross(lag.e1) / m_sq, out.to_lag[1]);
  copy(lag.m / m_sq, out.to_lag[2]);
  copy(start.e1, out.e1_start);
  copy(start.e2, out.e2_start);
  copy(lag.e1, out.e1_lag);
  copy(lag.e2, out.e2_lag);
  copy(part.a, out.a);
  copy(part.b, out.b);
  copy(frame.e1, out.e1);
  copy(frame.e2, out.e2);
  copy(frame.m, out.m);
  copy(frame.e2.cross(force), out.e2_force);
  copy(force.cross(frame.e1), out.force_e1);
}

/// Derivative of the friction of one contact.
class EntryDerivative {
 public:
  EntryDerivative(const ContactModel& model,
                  const Entry& entry,
                  const FrictionSet::Slip& at,
                  const FrictionSet::ExtensionDerivative& by,
                  const double* x,
                  const double* x_start,
                  const double* x_lag)
      : model_(model),
        k_(entry),
        law_(at.law),
        normal_force_(entry.lag, distance_sq_gradient(entry.lag.closest), x_lag) {
    const Closest& geometry = entry.lag.closest;
    const double strength = entry.mu * entry.lambda;
    kernel.corner = entry.lag.pair.vertices.data();
    kernel.corner_c = geometry.c.data();
    kernel.point = entry.points.data();
    kernel.c = entry.c.data();
    kernel.count = entry.count;
    kernel.part_count = entry.part_count;
    kernel.slides = geometry.parameter_count > 0;
    copy(entry.n, kernel.n);
    kernel.inv_d = 1.0 / std::sqrt(geometry.d_sq);
    copy(at.s, kernel.s);
    copy(at.w, kernel.w);
    kernel.n_s = entry.n.dot(at.s);
    Eigen::Map<Vec12>{kernel.by_corners} = (entry.mu * law_.f1_over_y) * normal_force_.by_corners;
    kernel.by_w = strength * law_.f2;
    kernel.stiffness = strength * law_.f1_over_y;
    const Vec3 force = strength * at.force();
    copy(force, kernel.force);
    if (kernel.slides) fill_sliding(entry, x, x_start, kernel);
    kernel.extension = entry.extension;
    copy(by.by_t, kernel.extension_by_t);
    copy(by.by_n, kernel.extension_by_n);
    copy(by.by_r, kernel.extension_by_r);
    for (int l = 0; l < entry.part_count; ++l) {
      for (int e = 0; e < 2; ++e) {
        copy(by.by_lag_edges[l][e], kernel.part[l].extension_by_lag[e]);
        copy(by.by_start_edges[l][e], kernel.part[l].extension_by_start[e]);
      }
      fill_part(entry, entry.parts[l], at.frames[l], force, x_start, x_lag, kernel.part[l]);
    }
  }

  /// Change of the coefficient of w with parameters.
  double by_parameters(const ContactModel::Bar& dot) const {
    const double lambda_dot =
        normal_force_.by_parameters(model_.push_forward(k_.lag, dot), dot.d_hat);
    const double mu_dot = model_.push_forward_mu(k_.lag.pair, dot);
    return (mu_dot * k_.lambda + k_.mu * lambda_dot) * law_.f1_over_y +
           k_.mu * k_.lambda * law_.f1_over_y_e * dot.slip;
  }

  FrictionTangent kernel;

 private:
  const ContactModel& model_;
  const Entry& k_;
  const FrictionLaw& law_;
  NormalForceDerivative normal_force_;
};

}  // namespace

void FrictionSet::add_tangents(const double* x,
                               std::span<const Tangents> directions,
                               std::span<double* const> y) const {
  const Slips& here = slips(x);
  const std::size_t size = 3 * static_cast<std::size_t>(model_->mesh().vertex_count);
  for_direction_groups(directions.size(), [&](const DirectionKernels& kernels, std::size_t first,
                                              std::size_t count) {
    std::vector<const double*> of_lag;
    std::vector<const double*> of_start;
    for (const Tangents& dot : directions.subspan(first, count)) {
      of_lag.push_back(dot.lag);
      of_start.push_back(dot.start);
    }
    DirectionRows lag(kernels, size);
    DirectionRows start(kernels, size);
    DirectionRows out(kernels, size);
    lag.read(of_lag);
    start.read(of_start);
    out.read(y.subspan(first, count));
    std::array<double, kDirectionLanes> by_parameters{};
    for (std::size_t e = 0; e < entries_.size(); ++e) {
      const EntryDerivative of(*model_, entries_[e], here[e], extension_derivative(entries_[e]), x,
                               x_start_, x_lag_);
      for (std::size_t l = 0; l < count; ++l) {
        const ContactModel::Bar* const dot = directions[first + l].parameters;
        if (dot != nullptr) by_parameters[l] = of.by_parameters(*dot);
      }
      kernels.friction_tangent(of.kernel, lag.data(), start.data(), by_parameters.data(),
                               out.data());
    }
    out.write(y.subspan(first, count));
  });
}

}  // namespace diffcloth::contact
