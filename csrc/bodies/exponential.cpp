#include "bodies/exponential.h"

#include <cmath>

namespace diffcloth::bodies {
namespace {

/// A function of s = |w|^2 and its first two derivatives.
struct Series {
  double f, f1, f2;
};

/// Bound of |w|^2 below which the series is summed; eight terms leave an error below 1e-17.
constexpr double kSmall = 0.25;
constexpr int kTerms = 8;

/// sum_k (-s)^k / (2k + m)!
Series sum(double s, int m) {
  double factorial = 1.0;
  for (int i = 2; i <= m; ++i) factorial *= i;
  Series r{.f = 0.0, .f1 = 0.0, .f2 = 0.0};
  double sign = 1.0;
  // Powers s^k, s^(k-1), s^(k-2).
  double p0 = 1.0;
  double p1 = 0.0;
  double p2 = 0.0;
  for (int k = 0; k < kTerms; ++k) {
    const double c = sign / factorial;
    r.f += c * p0;
    r.f1 += c * k * p1;
    r.f2 += c * k * (k - 1) * p2;
    p2 = p1;
    p1 = p0;
    p0 *= s;
    sign = -sign;
    factorial *= (2.0 * k + m + 1.0) * (2.0 * k + m + 2.0);
  }
  return r;
}

/// sin(t) / t as a function of s = t^2.
Series sine(double s) {
  if (s < kSmall) return sum(s, 1);
  const double t = std::sqrt(s);
  const double f = std::sin(t) / t;
  const double f1 = (std::cos(t) - f) / (2.0 * s);
  const double f2 = -(f + 6.0 * f1) / (4.0 * s);
  return {.f = f, .f1 = f1, .f2 = f2};
}

/// (1 - cos(t)) / t^2 as a function of s = t^2.
Series cosine(double s) {
  if (s < kSmall) return sum(s, 2);
  const double t = std::sqrt(s);
  const double f = (1.0 - std::cos(t)) / s;
  const double sinc = std::sin(t) / t;
  const double sinc1 = (std::cos(t) - sinc) / (2.0 * s);
  const double f1 = (0.5 * sinc - f) / s;
  const double f2 = (0.5 * sinc1 - 2.0 * f1) / s;
  return {.f = f, .f1 = f1, .f2 = f2};
}

}  // namespace

// R = I + a K + b K^2 with K = w x, a = sin t / t, b = (1 - cos t) / t^2 and t = |w|. Derivatives of a
// and b are with respect to s = t^2, and ds/dw_i = 2 w_i, d2s/dw_i dw_j = 2 delta_ij, dK/dw_i = E_i =
// e_i x.
Exponential::Exponential(const Vec3& w) {
  const double s = w.squaredNorm();
  const Series a = sine(s);
  const Series b = cosine(s);
  const Mat3 K = cross_matrix(w);
  const Mat3 K2 = K * K;
  std::array<Mat3, 3> E;
  std::array<Mat3, 3> EK;  // derivatives of K^2
  for (int i = 0; i < 3; ++i) {
    E[i] = cross_matrix(Vec3::Unit(i));
    EK[i] = E[i] * K + K * E[i];
  }
  value = Mat3::Identity() + a.f * K + b.f * K2;
  for (int i = 0; i < 3; ++i) {
    first[i] = 2.0 * w[i] * (a.f1 * K + b.f1 * K2) + a.f * E[i] + b.f * EK[i];
    for (int j = 0; j <= i; ++j) {
      Mat3 d = 4.0 * w[i] * w[j] * (a.f2 * K + b.f2 * K2) +
               2.0 * w[i] * (a.f1 * E[j] + b.f1 * EK[j]) +
               2.0 * w[j] * (a.f1 * E[i] + b.f1 * EK[i]) + b.f * (E[i] * E[j] + E[j] * E[i]);
      if (i == j) d += 2.0 * (a.f1 * K + b.f1 * K2);
      second[i][j] = d;
      second[j][i] = d;
    }
  }
}

}  // namespace diffcloth::bodies
