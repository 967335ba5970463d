#include "potential/shifted.h"

#include <algorithm>

namespace diffcloth {

Shifted::Shifted(Potential& potential, const std::vector<double>& shift)
    : potential_(potential), shift_(shift), at_(shift.size()) {}

const double* Shifted::less(const double* x) const {
  for (std::size_t a = 0; a < at_.size(); ++a) at_[a] = x[a] - shift_[a];
  return at_.data();
}

double Shifted::energy_change(const double* x, const double* to) const {
  const std::vector<double> start(less(x), less(x) + at_.size());
  return potential_.energy_change(start.data(), less(to));
}

void Shifted::extrapolate(const double* x, const double* to) {
  const std::vector<double> start(less(x), less(x) + at_.size());
  potential_.extrapolate(start.data(), less(to));
}

// -d/dd (z . grad P(x - d)) = H(x - d) z.
void Shifted::accumulate(const double* x, const double* z) {
  potential_.accumulate(less(x), z);
  if (shift_bar.empty()) shift_bar.assign(shift_.size(), 0.0);
  potential_.add_hessian_product(at_.data(), z, shift_bar.data());
}

void Shifted::add_tangent(const double* x, double* y) const {
  potential_.add_tangent(less(x), y);
  if (shift_dot.empty()) return;
  std::vector<double> minus(shift_dot.size());
  std::ranges::transform(shift_dot, minus.begin(), [](double value) { return -value; });
  potential_.add_hessian_product(at_.data(), minus.data(), y);
}

}  // namespace diffcloth
