#include "contact/friction_set.h"

#include <cmath>

#include "contact/distance/mollifier.h"
#include "contact/friction.h"

namespace diffcloth::contact {

FrictionSet::FrictionSet(const ContactModel& model, const std::vector<Contact>& contacts)
    : model_(&model) {
  entries_.reserve(contacts.size());
  for (const Contact& k : contacts) {
    const double d = std::sqrt(k.closest.d_sq);
    entries_.push_back({.lag = k,
                        .n = k.closest.t / d,
                        .lambda = -k.kappa * k.weight * k.mollifier * k.barrier.b1 * 2.0 * d,
                        .mu = model.mu(k.pair)});
  }
}

Vec3 FrictionSet::displacement(const Entry& entry, const double* x_start, const double* x) {
  Vec3 u = Vec3::Zero();
  for (int i = 0; i < 4; ++i) {
    const Index v = entry.lag.pair.vertices[i];
    u += entry.lag.closest.c[i] * (row(x, v) - row(x_start, v));
  }
  return u;
}

namespace {

Vec3 tangential(const Vec3& u, const Vec3& n) { return u - n.dot(u) * n; }

}  // namespace

double FrictionSet::energy_change(const double* x_start, const double* x0, const double* x1) const {
  const double e = entries_.empty() ? 1.0 : model_->parameters().slip;
  double change = 0.0;
  for (const Entry& k : entries_) {
    const double y0 = tangential(displacement(k, x_start, x0), k.n).norm();
    const double y1 = tangential(displacement(k, x_start, x1), k.n).norm();
    change += k.mu * k.lambda * (friction_law(y1, e).f0 - friction_law(y0, e).f0);
  }
  return change;
}

void FrictionSet::add_gradient(const double* x_start, const double* x, double* g) const {
  for (const Entry& k : entries_) {
    const Vec3 w = tangential(displacement(k, x_start, x), k.n);
    const FrictionLaw law = friction_law(w.norm(), model_->parameters().slip);
    const Vec3 force = (k.mu * k.lambda * law.f1_over_y) * w;
    for (int i = 0; i < 4; ++i) {
      Eigen::Map<Vec3>(g + 3 * k.lag.pair.vertices[i]) += k.lag.closest.c[i] * force;
    }
  }
}

FrictionSet::Hessian FrictionSet::hessian(const Entry& k,
                                          const double* x_start,
                                          const double* x,
                                          Curvature curvature) const {
  const Vec4& c = k.lag.closest.c;
  if (curvature == Curvature::kPositive && k.lambda < 0.0) return {.c = c, .core = Mat3::Zero()};
  const Vec3 w = tangential(displacement(k, x_start, x), k.n);
  const FrictionLaw law = friction_law(w.norm(), model_->parameters().slip);
  const Mat3 projector = Mat3::Identity() - k.n * k.n.transpose();
  const double along = curvature == Curvature::kExact ? law.f2 : 0.0;
  return {.c = c,
          .core = (k.mu * k.lambda) * (law.f1_over_y * projector + along * w * w.transpose())};
}

Vec12 FrictionSet::Hessian::operator*(const Vec12& z) const {
  Vec3 sum = Vec3::Zero();
  for (int q = 0; q < 4; ++q) sum += c[q] * z.segment<3>(3 * q);
  const Vec3 force = core * sum;
  Vec12 y;
  for (int p = 0; p < 4; ++p) y.segment<3>(3 * p) = c[p] * force;
  return y;
}

void FrictionSet::add_hessian_product(const double* x_start,
                                      const double* x,
                                      const double* z,
                                      double* y) const {
  for (const Entry& k : entries_) {
    const Vec12 product =
        hessian(k, x_start, x, Curvature::kExact) * stacked(k.lag.pair.vertices, z);
    for (int i = 0; i < 4; ++i) {
      Eigen::Map<Vec3>(y + 3 * k.lag.pair.vertices[i]) += product.segment<3>(3 * i);
    }
  }
}

// phi = mu lambda q(|w|) w . zeta,  q = f1/y,  w = P u,  u = sum c_i delta_i,  zeta = sum c_i z_i.
//
//   dphi/dw    = mu lambda (q zeta + f2 (w . zeta) w) =: omega      (f2 = q'/y)
//   dphi/du    = P omega,   dphi/dn = -(n.u) omega - (n.omega) u,   dphi/dzeta = mu lambda q w
//   dphi/dc_i  = (P omega) . delta_i + mu lambda q w . z_i
//
// and the lag configuration moves c through d(beta) = J dx, n through dn = P dt / d with
// dt = sum c_i dx_i + s d(beta), and lambda through
//   d(lambda) = -kappa w (2 d b' dm + m (2 d b'' + b'/d) dD).
void FrictionSet::add_mixed(const double* x_start,
                            const double* x,
                            const double* z,
                            const double* x_lag,
                            double scale,
                            ContactModel::Bar& bar,
                            double* lag_bar) const {
  for (const Entry& k : entries_) {
    const Contact& lag = k.lag;
    const Closest& geometry = lag.closest;
    const auto& v = lag.pair.vertices;
    const double kappa = lag.kappa;
    const double e = model_->parameters().slip;
    const double d = std::sqrt(geometry.d_sq);

    const Vec3 u = displacement(k, x_start, x);
    const Vec3 w = tangential(u, k.n);
    const FrictionLaw law = friction_law(w.norm(), e);
    Vec3 zeta = Vec3::Zero();
    for (int i = 0; i < 4; ++i) zeta += geometry.c[i] * row(z, v[i]);
    const double w_zeta = w.dot(zeta);

    const double mu_bar = k.lambda * law.f1_over_y * w_zeta;
    const double lambda_bar = k.mu * law.f1_over_y * w_zeta;
    bar.slip += scale * k.mu * k.lambda * law.f1_over_y_e * w_zeta;
    model_->pull_back_mu(lag.pair, scale * mu_bar, bar);

    // lambda's parameters.
    const double area = lag.weight;
    const double m = lag.mollifier;
    const double b1 = lag.barrier.b1;
    const double per_lambda = -2.0 * d * lambda_bar;
    model_->pull_back_kappa(lag.pair, scale * per_lambda * area * m * b1, bar);
    bar.d_hat += scale * per_lambda * kappa * area * m * lag.barrier.b1_d_hat;
    const double xi_bar = per_lambda * kappa * area * m * lag.barrier.b1_xi;
    Vec12 x_bar = (lambda_bar * -kappa * area * m * (2.0 * d * lag.barrier.b2 + b1 / d)) *
                  distance_sq_gradient(geometry);
    double threshold_bar = 0.0;
    if (lag.mollified) {
      const Mollifier mol = mollifier_derivatives(corners(v, x_lag), lag.threshold);
      threshold_bar = per_lambda * kappa * area * mol.m_eps * b1;
      x_bar += (per_lambda * kappa * area * b1) * mol.gradient;
    }
    model_->pull_back(lag, scale * per_lambda * kappa * m * b1, scale * threshold_bar,
                      scale * xi_bar, bar);

    // c and n.
    const double strength = k.mu * k.lambda;
    const Vec3 omega = strength * (law.f1_over_y * zeta + law.f2 * w_zeta * w);
    const Vec3 u_bar = tangential(omega, k.n);
    const Vec3 n_bar = -k.n.dot(u) * omega - k.n.dot(omega) * u;
    const Vec3 t_bar = tangential(n_bar, k.n) / d;
    Vec4 c_bar;
    for (int i = 0; i < 4; ++i) {
      c_bar[i] = u_bar.dot(row(x, v[i]) - row(x_start, v[i])) +
                 strength * law.f1_over_y * w.dot(row(z, v[i]));
      x_bar.segment<3>(3 * i) += geometry.c[i] * t_bar;
    }
    if (geometry.parameter_count > 0) {
      Vec2 beta_bar = geometry.s.transpose() * t_bar + geometry.c_beta.transpose() * c_bar;
      if (geometry.parameter_count == 1) beta_bar[1] = 0.0;
      x_bar += beta_jacobian(geometry).transpose() * beta_bar;
    }
    for (int i = 0; i < 4; ++i) {
      Eigen::Map<Vec3>(lag_bar + 3 * v[i]) += scale * x_bar.segment<3>(3 * i);
    }
  }
}

}  // namespace diffcloth::contact
