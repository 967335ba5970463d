#include "elastic/spring_rate.h"

namespace diffcloth::elastic {
namespace {

/// Change of P r along a change of the spring's extension e, for P = n n^T.
Vec3 change_of_projected(const Vec3& e, const Vec3& change, const Vec3& r) {
  const double length = e.norm();
  if (length == 0.0) return Vec3::Zero();
  const Vec3 n = e / length;
  const Vec3 turn = (change - n.dot(change) * n) / length;
  return turn.dot(r) * n + n.dot(r) * turn;
}

/// Derivative of z . P r by e: change_of_projected(), transposed.
Vec3 extension_bar(const Vec3& e, const Vec3& z, const Vec3& r) {
  const double length = e.norm();
  if (length == 0.0) return Vec3::Zero();
  const Vec3 n = e / length;
  const auto across = [&](const Vec3& v) { return Vec3(v - n.dot(v) * n); };
  return (n.dot(r) * across(z) + n.dot(z) * across(r)) / length;
}

}  // namespace

SpringRate::SpringRate(SpringPotential& potential,
                       const std::vector<double>& middle,
                       const std::vector<double>& start)
    : middle_bar(start.size(), 0.0),
      start_bar(start.size(), 0.0),
      potential_(potential),
      springs_(potential.springs()),
      middle_(middle),
      start_(start) {}

std::vector<double> SpringRate::displacement(const double* x) const {
  std::vector<double> d(start_.size());
  for (std::size_t a = 0; a < d.size(); ++a) d[a] = x[a] - start_[a];
  return d;
}

Vec3 SpringRate::projected(Index a, const Vec3& r) const {
  if (!has_length(springs_, a)) return r;
  const Vec3 e = extension(springs_, a, middle_.data());
  const double squared = e.squaredNorm();
  return squared == 0.0 ? Vec3(Vec3::Zero()) : Vec3(e.dot(r) / squared * e);
}

Mat3 SpringRate::core(Index a) const {
  const double k = springs_.stiffness[a];
  if (!has_length(springs_, a)) return k * Mat3::Identity();
  const Vec3 e = extension(springs_, a, middle_.data());
  const double squared = e.squaredNorm();
  return squared == 0.0 ? Mat3(Mat3::Zero()) : Mat3(k / squared * e * e.transpose());
}

double SpringRate::energy(const double* x) const {
  const std::vector<double> d = displacement(x);
  double total = 0.0;
  springs_.for_each_pulling([&](Index a) {
    const Vec3 r = difference(springs_, a, d.data());
    total += 0.5 * springs_.stiffness[a] * r.dot(projected(a, r));
  });
  return total;
}

double SpringRate::energy_change(const double* x, const double* to) const {
  const std::vector<double> d = displacement(x);
  double total = 0.0;
  springs_.for_each_pulling([&](Index a) {
    const Vec3 step = difference(springs_, a, to) - difference(springs_, a, x);
    const Vec3 r = difference(springs_, a, d.data()) + 0.5 * step;
    total += springs_.stiffness[a] * step.dot(projected(a, r));
  });
  return total;
}

void SpringRate::add_gradient(const double* x, double* g) const {
  add_hessian_product(x, displacement(x).data(), g);
}

void SpringRate::add_hessian(const double* /*x*/,
                             Curvature /*curvature*/,
                             linalg::BlockMatrix& A) const {
  std::vector<Mat3> changes;
  springs_.for_each_pulling([&](Index a) {
    changes.clear();
    for (const double b : springs_.coefficients(a)) changes.emplace_back(b * Mat3::Identity());
    A.add_congruence(springs_.points(a), changes, core(a));
  });
}

void SpringRate::add_hessian_product(const double* /*x*/, const double* z, double* y) const {
  springs_.for_each_pulling([&](Index a) {
    const Vec3 force = springs_.stiffness[a] * projected(a, difference(springs_, a, z));
    add_to_points(springs_, a, force, y);
  });
}

void SpringRate::add_left_out_products(const double* x,
                                       Curvature /*curvature*/,
                                       const Products& products) const {
  add_hessian_products(x, products);
}

void SpringRate::accumulate(const double* x, const double* z) {
  const std::vector<double> d = displacement(x);
  for (Index a = 0; a < springs_.size(); ++a) {
    const Vec3 r = difference(springs_, a, d.data());
    const Vec3 r_z = difference(springs_, a, z);
    potential_.stiffness_bar[a] -= r_z.dot(projected(a, r));
    const double k = springs_.stiffness[a];
    if (k == 0.0) continue;
    add_to_points(springs_, a, k * projected(a, r_z), start_bar.data());
    if (!has_length(springs_, a)) continue;
    const Vec3 bar = k * extension_bar(extension(springs_, a, middle_.data()), r_z, r);
    add_to_points(springs_, a, -bar, middle_bar.data());
    const Index target = springs_.target_row[a];
    if (target >= 0) Eigen::Map<Vec3>(potential_.target_bar.data() + 3 * target) += bar;
  }
}

void SpringRate::add_tangent(const double* x, double* y) const {
  const std::vector<double> d = displacement(x);
  for (Index a = 0; a < springs_.size(); ++a) {
    const Vec3 r = difference(springs_, a, d.data());
    const double k = springs_.stiffness[a];
    Vec3 force = potential_.stiffness_dot[a] * projected(a, r) -
                 k * projected(a, difference(springs_, a, start_dot.data()));
    if (has_length(springs_, a)) {
      Vec3 change = difference(springs_, a, middle_dot.data());
      const Index target = springs_.target_row[a];
      if (target >= 0) change -= row(potential_.target_dot.data(), target);
      force += k * change_of_projected(extension(springs_, a, middle_.data()), change, r);
    }
    add_to_points(springs_, a, force, y);
  }
}

}  // namespace diffcloth::elastic
