#pragma once

#include <array>
#include <cmath>

#include <Eigen/Core>

namespace diffcloth {

/// A number with its derivatives along n directions (forward mode), for cold paths.
template <int n>
struct Dual {
  double value = 0.0;
  Eigen::Matrix<double, n, 1> derivative = Eigen::Matrix<double, n, 1>::Zero();

  Dual() = default;
  Dual(double v) : value(v) {}  // NOLINT(google-explicit-constructor): constants mix in
  Dual(double v, const Eigen::Matrix<double, n, 1>& d) : value(v), derivative(d) {}

  /// The i-th independent variable.
  static Dual variable(double v, int i) { return {v, Eigen::Matrix<double, n, 1>::Unit(i)}; }

  friend Dual operator-(const Dual& a) { return {-a.value, -a.derivative}; }
  friend Dual operator+(const Dual& a, const Dual& b) {
    return {a.value + b.value, a.derivative + b.derivative};
  }
  friend Dual operator-(const Dual& a, const Dual& b) {
    return {a.value - b.value, a.derivative - b.derivative};
  }
  friend Dual operator*(const Dual& a, const Dual& b) {
    return {a.value * b.value, b.value * a.derivative + a.value * b.derivative};
  }
  friend Dual operator/(const Dual& a, const Dual& b) {
    const double quotient = a.value / b.value;
    return {quotient, (a.derivative - quotient * b.derivative) / b.value};
  }
  friend Dual sqrt(const Dual& a) {
    const double root = std::sqrt(a.value);
    return {root, a.derivative / (2.0 * root)};
  }
  friend bool operator<(const Dual& a, const Dual& b) { return a.value < b.value; }
  friend bool operator>(const Dual& a, const Dual& b) { return a.value > b.value; }
};

/// The values as independent variables.
template <int n>
std::array<Dual<n>, n> variables(const std::array<double, n>& values) {
  std::array<Dual<n>, n> result;
  for (int i = 0; i < n; ++i) result[i] = Dual<n>::variable(values[i], i);
  return result;
}

}  // namespace diffcloth
