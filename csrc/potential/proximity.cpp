#include "potential/proximity.h"

namespace diffcloth {

Proximity::Proximity(std::vector<double> metric, std::vector<double> target, double h)
    : metric_bar(metric.size(), 0.0),
      target_bar(target.size(), 0.0),
      metric_(std::move(metric)),
      target_(std::move(target)),
      inv_h_sq_(1.0 / (h * h)) {}

double Proximity::energy(const double* x) const {
  double e = 0.0;
  for (Index i = 0; i < size(); ++i) {
    e += metric_[i] * (row(x, i) - row(target_.data(), i)).squaredNorm();
  }
  return 0.5 * inv_h_sq_ * e;
}

double Proximity::energy_change(const double* x, const double* to) const {
  double change = 0.0;
  for (Index i = 0; i < size(); ++i) {
    const Vec3 step = row(to, i) - row(x, i);
    change += metric_[i] * step.dot(2.0 * (row(x, i) - row(target_.data(), i)) + step);
  }
  return 0.5 * inv_h_sq_ * change;
}

void Proximity::add_gradient(const double* x, double* g) const {
  for (Index i = 0; i < size(); ++i) {
    Eigen::Map<Vec3>(g + 3 * i) += metric_[i] * inv_h_sq_ * (row(x, i) - row(target_.data(), i));
  }
}

void Proximity::add_hessian(const double* /*x*/,
                            Curvature /*curvature*/,
                            linalg::BlockMatrix& A) const {
  for (Index i = 0; i < size(); ++i) A.add_to_diagonal(i, metric_[i] * inv_h_sq_);
}

void Proximity::add_hessian_product(const double* /*x*/, const double* z, double* y) const {
  for (Index i = 0; i < size(); ++i) {
    Eigen::Map<Vec3>(y + 3 * i) += metric_[i] * inv_h_sq_ * row(z, i);
  }
}

void Proximity::accumulate(const double* x, const double* z) {
  for (Index i = 0; i < size(); ++i) {
    const Vec3 z_i = row(z, i);
    Eigen::Map<Vec3>(target_bar.data() + 3 * i) += metric_[i] * inv_h_sq_ * z_i;
    metric_bar[i] -= inv_h_sq_ * z_i.dot(row(x, i) - row(target_.data(), i));
  }
}

void Proximity::add_tangent(const double* x, double* y) const {
  for (Index i = 0; i < size(); ++i) {
    const Vec3 offset = row(x, i) - row(target_.data(), i);
    Eigen::Map<Vec3>(y + 3 * i) +=
        inv_h_sq_ * (metric_dot[i] * offset - metric_[i] * row(target_dot.data(), i));
  }
}

}  // namespace diffcloth
