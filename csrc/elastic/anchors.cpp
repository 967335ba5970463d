#include "elastic/anchors.h"

#include <cstddef>

namespace diffcloth::elastic {
namespace {

Vec3 extension(const Anchors& anchors, std::size_t a, const double* x) {
  return row(x, anchors.vertex[a]) - row(anchors.target.data(), static_cast<Index>(a));
}

}  // namespace

double energy(const Anchors& anchors, const double* x) {
  double total = 0.0;
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    total += 0.5 * anchors.stiffness[a] * extension(anchors, a, x).squaredNorm();
  }
  return total;
}

double energy_change(const Anchors& anchors, const double* x0, const double* x1) {
  double total = 0.0;
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    const Vec3 step = row(x1, anchors.vertex[a]) - row(x0, anchors.vertex[a]);
    total += 0.5 * anchors.stiffness[a] *
             step.dot(extension(anchors, a, x0) + extension(anchors, a, x1));
  }
  return total;
}

void add_gradient(const Anchors& anchors, const double* x, double* g) {
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    Eigen::Map<Vec3>(g + 3 * anchors.vertex[a]) += anchors.stiffness[a] * extension(anchors, a, x);
  }
}

void add_hessian(const Anchors& anchors, std::span<const Index> diagonal_slot, double* blocks) {
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    const std::ptrdiff_t slot = diagonal_slot[anchors.vertex[a]];
    Eigen::Map<Mat3>(blocks + 9 * slot).diagonal().array() += anchors.stiffness[a];
  }
}

void add_hessian_product(const Anchors& anchors, const double* z, double* y) {
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    const Index i = anchors.vertex[a];
    Eigen::Map<Vec3>(y + 3 * i) += anchors.stiffness[a] * row(z, i);
  }
}

void add_mixed(const Anchors& anchors,
               const double* x,
               const double* z,
               double* stiffness_bar,
               double* target_bar) {
  for (std::size_t a = 0; a < anchors.vertex.size(); ++a) {
    const Vec3 z_a = row(z, anchors.vertex[a]);
    stiffness_bar[a] += z_a.dot(extension(anchors, a, x));
    Eigen::Map<Vec3>(target_bar + 3 * a) -= anchors.stiffness[a] * z_a;
  }
}

}  // namespace diffcloth::elastic
