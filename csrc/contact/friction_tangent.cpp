// How the gradient of lagged friction changes with what it depends on besides x, in the terms of friction_set.h:
//
//   grad D = mu lambda q B^T w,   q = f1/|w|,   w = P s,   s = r(x) - E(x) a,
//   a = E(x_start)^-1 share r(x_start),   of each part.
//
// Of each contact everything that belongs to no direction is made once.

#include <cmath>

#include "contact/distance/mollifier.h"
#include "contact/friction_set.h"

namespace diffcloth::contact {
namespace {

using Entry = FrictionSet::Entry;
using Frame = FrictionSet::Frame;
using Part = FrictionSet::Part;

/// How the normal force changes,  lambda = -2 d kappa w m b'(D).
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

/// The derivative of one contact's friction.
class EntryDerivative {
 public:
  EntryDerivative(const ContactModel& model,
                  const Entry& entry,
                  const FrictionSet::Slip& at,
                  const double* x,
                  const double* x_start,
                  const double* x_lag)
      : model_(model),
        k_(entry),
        at_(at),
        normal_force_(entry.lag, distance_sq_gradient(entry.lag.closest), x_lag),
        slides_(entry.lag.closest.parameter_count > 0),
        inv_d_(1.0 / std::sqrt(entry.lag.closest.d_sq)),
        strength_(entry.mu * entry.lambda),
        force_(strength_ * at.force()) {
    if (slides_) {
      beta_ = beta_jacobian(entry.lag.closest);
      if (entry.lag.closest.parameter_count == 1) beta_.row(1).setZero();
      const auto& v = entry.lag.pair.vertices;
      for (int i = 0; i < 4; ++i) {
        corners_.col(i) = row(x, v[i]) - row(x, v[0]);
        corners_start_.col(i) = row(x_start, v[i]) - row(x_start, v[0]);
      }
    }
    for (int l = 0; l < entry.part_count; ++l) {
      if (!entry.parts[l].turns) continue;
      const Frame& start = starts_[l] = Frame(entry, entry.parts[l], x_start);
      Mat3& to_coordinates = to_coordinates_[l];
      to_coordinates.row(0) = start.e2.cross(start.m);
      to_coordinates.row(1) = start.m.cross(start.e1);
      to_coordinates.row(2) = start.m;
      to_coordinates /= start.m.squaredNorm();
    }
  }

  void add(const FrictionSet::Tangents& dot, double* y) const {
    const auto& v = k_.lag.pair.vertices;
    const Closest& geometry = k_.lag.closest;
    // What the lag configuration gives: c(beta), n = t / d with t = sum_i c_i x_i, and lambda.
    const Vec12 x_dot = stacked(v, dot.lag);
    Vec3 t_dot = Vec3::Zero();
    for (int i = 0; i < 4; ++i) t_dot += geometry.c[i] * x_dot.segment<3>(3 * i);
    Vec3 s_dot = Vec3::Zero();
    Vec3 r_dot = k_.gap(dot.start);
    if (slides_) {
      const Vec2 beta_dot = beta_.lazyProduct(x_dot);
      const Vec4 c_dot = geometry.c_beta * beta_dot;
      t_dot += geometry.s * beta_dot;
      s_dot = corners_.lazyProduct(c_dot);
      r_dot += corners_start_.lazyProduct(c_dot);
      for (int i = 0; i < 4; ++i) Eigen::Map<Vec3>(y + 3 * v[i]) += c_dot[i] * force_;
    }
    const Vec3 n_dot = inv_d_ * tangential(t_dot, k_.n);

    // s = r(x) - Q r(x_start), and r(x_start) in its frames.
    std::array<Vec3, 2> a_dot;
    for (int l = 0; l < k_.part_count; ++l) {
      const Part& part = k_.parts[l];
      if (!part.turns) {
        s_dot -= part.share * r_dot;
        continue;
      }
      const Frame& start = starts_[l];
      const Vec3 e1_dot = k_.edge(part, 0, dot.start);
      const Vec3 e2_dot = k_.edge(part, 1, dot.start);
      const Vec3 of_start =
          part.share * r_dot - (part.a[0] * e1_dot + part.a[1] * e2_dot +
                                part.a[2] * (e1_dot.cross(start.e2) + start.e1.cross(e2_dot)));
      a_dot[l] = to_coordinates_[l].lazyProduct(of_start);
      s_dot -= at_.frames[l] * a_dot[l];
    }
    const double n_s = k_.n.dot(at_.s);
    const Vec3 w_dot = tangential(s_dot, k_.n) - n_dot.dot(at_.s) * k_.n - n_s * n_dot;

    const FrictionLaw& law = at_.law;
    double along_w = k_.mu * normal_force_.by_corners.dot(x_dot) * law.f1_over_y +
                     strength_ * law.f2 * at_.w.dot(w_dot);
    if (dot.parameters != nullptr) along_w += by_parameters(*dot.parameters);
    const Vec3 change = along_w * at_.w + (strength_ * law.f1_over_y) * w_dot;
    for (int i = 0; i < k_.count; ++i) Eigen::Map<Vec3>(y + 3 * k_.points[i]) += k_.c[i] * change;
    for (int l = 0; l < k_.part_count; ++l) {
      const Part& part = k_.parts[l];
      if (!part.turns) continue;
      const auto [by_a_1, by_a_2] = at_.frames[l].pull_back(part.a, change);
      const auto [by_force_1, by_force_2] = at_.frames[l].pull_back(a_dot[l], force_);
      k_.add_edges(part, {-by_a_1 - by_force_1, -by_a_2 - by_force_2}, y);
    }
  }

 private:
  /// What the share of w grows by.
  double by_parameters(const ContactModel::Bar& dot) const {
    const double lambda_dot =
        normal_force_.by_parameters(model_.push_forward(k_.lag, dot), dot.d_hat);
    const double mu_dot = model_.push_forward_mu(k_.lag.pair, dot);
    return (mu_dot * k_.lambda + k_.mu * lambda_dot) * at_.law.f1_over_y +
           strength_ * at_.law.f1_over_y_e * dot.slip;
  }

  const ContactModel& model_;
  const Entry& k_;
  const FrictionSet::Slip& at_;
  std::array<Frame, 2> starts_;  ///< of the parts that turn
  NormalForceDerivative normal_force_;
  bool slides_;  ///< whether the nearest points do, on their primitives
  double inv_d_;
  double strength_;
  Vec3 force_;
  Eigen::Matrix<double, 2, 12> beta_;          ///< of the nearest points, where they slide
  Eigen::Matrix<double, 3, 4> corners_;        ///< from the first, at x
  Eigen::Matrix<double, 3, 4> corners_start_;  ///< at x_start
  std::array<Mat3, 2> to_coordinates_;         ///< E(x_start)^-1, of the parts that turn
};

}  // namespace

void FrictionSet::add_tangents(const double* x,
                               const double* x_lag,
                               std::span<const Tangents> directions,
                               std::span<double* const> y) const {
  const Slips& here = slips(x);
  for (std::size_t e = 0; e < entries_.size(); ++e) {
    const EntryDerivative of(*model_, entries_[e], here[e], x, x_start_, x_lag);
    for (std::size_t l = 0; l < directions.size(); ++l) of.add(directions[l], y[l]);
  }
}

}  // namespace diffcloth::contact
