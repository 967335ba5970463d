#include "bodies/free_turn.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include <Eigen/Core>
#include <Eigen/LU>

#include "common/types.h"

namespace diffcloth::bodies {
namespace {

/// Largest angle [rad] of one series. The radius of convergence is a quarter of a turn, limited by the
/// poles of l: the poles of its fastest hyperbolic functions.
constexpr double kAngle = 0.25;
constexpr double kRadius = 1.5;
/// Last term relative to the first, and the largest number of terms to reach it.
constexpr double kRounding = 1e-18;
constexpr int kMostTerms = 24;
constexpr double kMostSeries = 2e4;

constexpr int kInputs = 12;

/// A number with its derivatives by J and l.
struct Dual {
  double value = 0.0;
  Eigen::Array<double, kInputs, 1> rate = Eigen::Array<double, kInputs, 1>::Zero();
};

Dual operator+(const Dual& a, const Dual& b) {
  return {.value = a.value + b.value, .rate = a.rate + b.rate};
}
Dual operator-(const Dual& a, const Dual& b) {
  return {.value = a.value - b.value, .rate = a.rate - b.rate};
}
Dual operator*(const Dual& a, const Dual& b) {
  return {.value = a.value * b.value, .rate = a.value * b.rate + b.value * a.rate};
}
Dual operator*(double a, const Dual& b) { return {.value = a * b.value, .rate = a * b.rate}; }

double reciprocal_root(double a) { return 1.0 / std::sqrt(a); }
Dual reciprocal_root(const Dual& a) {
  const double r = 1.0 / std::sqrt(a.value);
  return {.value = r, .rate = (-0.5 * r * r * r) * a.rate};
}

template <class T>
using Three = std::array<T, 3>;
template <class T>
using Four = std::array<T, 4>;

/// Number of terms of a series over an angle [rad].
int term_count(double angle) {
  const double ratio = std::max(angle / kRadius, kRounding);
  return std::min(kMostTerms, 2 + static_cast<int>(std::log(kRounding) / std::log(ratio)));
}

/// Advance q and l over one series.
template <class T>
void advance(
    const std::array<Three<T>, 3>& inverse, double time, int terms, Four<T>& q, Three<T>& l) {
  std::array<Four<T>, kMostTerms + 1> qs{q};
  std::array<Three<T>, kMostTerms + 1> ls{l};
  std::array<Three<T>, kMostTerms + 1> ws;  // for time scaled to 1
  for (int k = 0; k < terms; ++k) {
    for (std::size_t i = 0; i < 3; ++i) {
      ws[k][i] =
          time * (inverse[i][0] * ls[k][0] + inverse[i][1] * ls[k][1] + inverse[i][2] * ls[k][2]);
    }
    Four<T> dq{};
    Three<T> dl{};
    for (int j = 0; j <= k; ++j) {
      const Four<T>& p = qs[j];
      const Three<T>& m = ls[j];
      const Three<T>& w = ws[k - j];
      dq[0] = dq[0] - (p[1] * w[0] + p[2] * w[1] + p[3] * w[2]);
      dq[1] = dq[1] + (p[0] * w[0] + p[2] * w[2] - p[3] * w[1]);
      dq[2] = dq[2] + (p[0] * w[1] + p[3] * w[0] - p[1] * w[2]);
      dq[3] = dq[3] + (p[0] * w[2] + p[1] * w[1] - p[2] * w[0]);
      dl[0] = dl[0] + (m[1] * w[2] - m[2] * w[1]);
      dl[1] = dl[1] + (m[2] * w[0] - m[0] * w[2]);
      dl[2] = dl[2] + (m[0] * w[1] - m[1] * w[0]);
    }
    for (std::size_t i = 0; i < 4; ++i) qs[k + 1][i] = (0.5 / (k + 1)) * dq[i];
    for (std::size_t i = 0; i < 3; ++i) ls[k + 1][i] = (1.0 / (k + 1)) * dl[i];
  }
  for (int k = terms - 1; k >= 0; --k) {  // small terms first
    for (std::size_t i = 0; i < 4; ++i) qs[k][i] = qs[k][i] + qs[k + 1][i];
    for (std::size_t i = 0; i < 3; ++i) ls[k][i] = ls[k][i] + ls[k + 1][i];
  }
  const Four<T>& p = qs[0];
  const T scale = reciprocal_root(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
  for (std::size_t i = 0; i < 4; ++i) q[i] = scale * p[i];
  l = ls[0];
}

}  // namespace

bool free_turn(
    const double* inertia, const double* momentum, double time, Turn& turn, TurnRate* rate) {
  const Mat3 inverse =
      Mat3(Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(inertia)).inverse();
  const Vec3 l_start = row(momentum, 0);
  // omega| <= sqrt(2 T / smallest J), and the largest 1/J is at most the trace of J^-1.
  const double speed = std::sqrt(l_start.dot(inverse * l_start) * inverse.trace());
  const double series = std::max(1.0, std::ceil(speed * time / kAngle));
  if (!(series <= kMostSeries)) return false;
  const auto count = static_cast<int>(series);
  const double part = time / count;
  const int terms = term_count(speed * part);

  {
    std::array<Three<double>, 3> J;
    for (int i = 0; i < 3; ++i) J[i] = {inverse(i, 0), inverse(i, 1), inverse(i, 2)};
    Three<double> l{l_start[0], l_start[1], l_start[2]};
    turn = {1.0, 0.0, 0.0, 0.0};
    for (int k = 0; k < count; ++k) advance(J, part, terms, turn, l);
  }
  if (rate == nullptr) return true;

  std::array<Three<Dual>, 3> J;
  Three<Dual> l;
  for (int i = 0; i < 3; ++i) {
    l[i].value = l_start[i];
    l[i].rate[9 + i] = 1.0;
    for (int j = 0; j < 3; ++j) {
      J[i][j].value = inverse(i, j);
      // d(J^-1) = -J^-1 dJ J^-1.
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) J[i][j].rate[3 * a + b] = -inverse(i, a) * inverse(b, j);
      }
    }
  }
  Four<Dual> q{};
  q[0].value = 1.0;
  for (int k = 0; k < count; ++k) advance(J, part, terms, q, l);
  for (int i = 0; i < 4; ++i) std::copy_n(q[i].rate.data(), kInputs, (*rate)[i].begin());
  return true;
}

}  // namespace diffcloth::bodies
