#include "elastic/elastic_nearness.h"

#include <span>
#include <utility>

namespace diffcloth::elastic {

ElasticNearness::ElasticNearness(ConstantForm form,
                                 ElasticPotential& elasticity,
                                 std::vector<SpringPotential*> springs,
                                 std::vector<double> target)
    : target_bar(target.size(), 0.0),
      form_(std::move(form)),
      elasticity_(elasticity),
      springs_(std::move(springs)),
      target_(std::move(target)) {}

std::vector<double> ElasticNearness::offset(const double* x) const {
  std::vector<double> u(target_.size());
  for (std::size_t a = 0; a < u.size(); ++a) u[a] = x[a] - target_[a];
  return u;
}

double ElasticNearness::energy(const double* x) const {
  const std::vector<double> zero(target_.size(), 0.0);
  return form_.energy_change(zero.data(), offset(x).data());
}

double ElasticNearness::energy_change(const double* x, const double* to) const {
  std::vector<double> step(target_.size());
  for (std::size_t a = 0; a < step.size(); ++a) step[a] = to[a] - x[a];
  return form_.energy_change(offset(x).data(), step.data());
}

void ElasticNearness::add_gradient(const double* x, double* g) const {
  form_.add_product(offset(x).data(), g);
}

void ElasticNearness::add_hessian(const double* /*x*/,
                                  Curvature /*curvature*/,
                                  linalg::BlockMatrix& A) const {
  const std::span<const double> values = form_.values();
  for (std::size_t k = 0; k < values.size(); ++k) {
    double* block = A.blocks() + 9 * static_cast<std::ptrdiff_t>(A.slot_of_base()[k]);
    for (int a = 0; a < 3; ++a) block[4 * a] += values[k];
  }
}

void ElasticNearness::add_hessian_product(const double* /*x*/, const double* z, double* y) const {
  form_.add_product(z, y);
}

// grad P = L (x - y): y gets L z, and the parameters of L get  -z . dL (x - y).
void ElasticNearness::accumulate(const double* x, const double* z) {
  form_.add_product(z, target_bar.data());
  const std::vector<double> u = offset(x);
  if (elasticity_.wanted() != Wanted::kNone) {
    std::vector<double> minus_u = u;
    for (double& value : minus_u) value = -value;
    add_constant_form_mixed(elasticity_.model(), minus_u.data(), z,
                            elasticity_.wanted() == Wanted::kMaterialsAndRest, elasticity_.bar());
  }
  for (SpringPotential* const kind : springs_) {
    const Springs& springs = kind->springs();
    for (Index a = 0; a < springs.size(); ++a) {
      kind->stiffness_bar[a] -= difference(springs, a, z).dot(difference(springs, a, u.data()));
    }
  }
}

void ElasticNearness::add_tangent(const double* x, double* y) const {
  std::vector<double> minus(target_dot.size());
  for (std::size_t a = 0; a < minus.size(); ++a) minus[a] = -target_dot[a];
  form_.add_product(minus.data(), y);
  const std::vector<double> u = offset(x);
  elasticity_.add_constant_form_tangent(u.data(), y);
  for (const SpringPotential* const kind : springs_) {
    const Springs& springs = kind->springs();
    for (Index a = 0; a < springs.size(); ++a) {
      const Vec3 force = kind->stiffness_dot[a] * difference(springs, a, u.data());
      const auto points = springs.points(a);
      for (std::size_t p = 0; p < points.size(); ++p) {
        Eigen::Map<Vec3>(y + 3 * points[p]) += springs.coefficients(a)[p] * force;
      }
    }
  }
}

}  // namespace diffcloth::elastic
