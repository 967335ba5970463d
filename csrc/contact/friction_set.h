#pragma once

#include <vector>

#include "contact/contact_set.h"

namespace diffcloth::contact {

/// Lagged friction: sum over contacts of mu lambda f0(|w|; e)  [J],
///
///   w = (I - n n^T) sum_i c_i delta_i,   delta_i = x_i - x_start_i,   e = eps_v h,
///
/// with c, n and the normal force lambda = -kappa w m b'(D) 2 d [N] of the lag configuration held
/// fixed. Obstacle vertices take part in delta, so that a moving body drags the cloth.
class FrictionSet {
 public:
  FrictionSet() = default;

  /// @param contacts  the contacts of the lag configuration
  FrictionSet(const ContactModel& model, const std::vector<Contact>& contacts);

  const ContactModel& model() const { return *model_; }
  bool empty() const { return entries_.empty(); }

  struct Entry {
    Contact lag;
    Vec3 n;         ///< unit normal at the lag configuration
    double lambda;  ///< normal force at the lag configuration [N]
    double mu;
  };
  const std::vector<Entry>& entries() const { return entries_; }

  double energy_change(const double* x_start, const double* x0, const double* x1) const;
  void add_gradient(const double* x_start, const double* x, double* g) const;

  /// A Hessian c c^T (x) core by its 3x3 blocks.
  struct Hessian {
    Vec4 c;
    Mat3 core;

    Mat3 operator()(int p, int q) const { return (c[p] * c[q]) * core; }
    Vec12 operator*(const Vec12& z) const;
  };

  /// Hessian of one entry, of the sign of lambda. kPositive is the quadratic majorant (f1/|w|) P,
  /// which does not lose its curvature where a sliding contact would come to rest, and zero where
  /// lambda is negative.
  Hessian hessian(const Entry& entry,
                  const double* x_start,
                  const double* x,
                  Curvature curvature) const;

  /// y += H z over all vertices.
  void add_hessian_product(const double* x_start,
                           const double* x,
                           const double* z,
                           double* y) const;

  /// d/d(theta) of phi = z . grad D, times scale: into `bar` for the parameters (friction, slip,
  /// and, through lambda, kappa, d_hat, thickness, rest shape), and into `lag_bar` for the lag
  /// configuration's positions `x_lag`.
  void add_mixed(const double* x_start,
                 const double* x,
                 const double* z,
                 const double* x_lag,
                 double scale,
                 ContactModel::Bar& bar,
                 double* lag_bar) const;

 private:
  /// sum_i c_i (x_i - x_start_i), before projection.
  static Vec3 displacement(const Entry& entry, const double* x_start, const double* x);

  const ContactModel* model_ = nullptr;
  std::vector<Entry> entries_;
};

}  // namespace diffcloth::contact
