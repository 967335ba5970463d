#include "projective/anderson.h"

#include <algorithm>
#include <array>

#include <Eigen/QR>

namespace diffcloth::projective {
namespace {

/// Relative tolerance below which a change counts as a linear combination of others.
constexpr double kDependent = 1e-12;

double dot(const std::vector<double>& a, const double* b) {
  // Four independent sums, so that additions do not wait for each other.
  const std::size_t n = a.size();
  std::array<double, 4> sum{};
  std::size_t k = 0;
  for (; k + 4 <= n; k += 4) {
    for (std::size_t i = 0; i < 4; ++i) sum[i] += a[k + i] * b[k + i];
  }
  for (; k < n; ++k) sum[0] += a[k] * b[k];
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

}  // namespace

Anderson::Anderson(std::size_t size) : size_(size), last_end_(size), last_p_(size), last_q_(size) {
  changes_.resize(kWindow);
  for (Change& change : changes_) {
    change.step.resize(size);
    change.p.resize(size);
    change.q.resize(size);
  }
  products_.setZero(kWindow, kWindow);
}

void Anderson::next(const double* x, const double* p, const double* q, double* to) {
  for (std::size_t a = 0; a < size_; ++a) to[a] = x[a] + p[a];
  if (has_last_) {
    newest_ = (newest_ + 1) % kWindow;
    count_ = std::min(count_ + 1, kWindow);
    Change& change = changes_[newest_];
    for (std::size_t a = 0; a < size_; ++a) {
      change.step[a] = to[a] - last_end_[a];
      change.p[a] = p[a] - last_p_[a];
      change.q[a] = q[a] - last_q_[a];
    }
    // Until the ring is full, its first slots are in use.
    for (int k = 0; k < count_; ++k) {
      products_(k, newest_) = products_(newest_, k) = dot(changes_[k].p, change.q.data());
    }
  }
  std::copy_n(to, size_, last_end_.begin());
  std::copy_n(p, size_, last_p_.begin());
  std::copy_n(q, size_, last_q_.begin());
  has_last_ = true;
  if (count_ == 0) return;

  Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kWindow, 1> b(count_);
  for (int k = 0; k < count_; ++k) b[k] = dot(changes_[k].p, q);
  const Gram gram = products_.topLeftCorner(count_, count_);
  Eigen::ColPivHouseholderQR<Gram> qr(gram.rows(), gram.cols());
  qr.setThreshold(kDependent);
  qr.compute(gram);
  b = qr.solve(b).eval();
  for (int k = 0; k < count_; ++k) {
    const double share = b[k];
    const double* const step = changes_[k].step.data();
    for (std::size_t a = 0; a < size_; ++a) to[a] -= share * step[a];
  }
}

}  // namespace diffcloth::projective
