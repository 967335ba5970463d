#include "projective/local_global.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "projective/anderson.h"

namespace diffcloth::projective {
namespace {

/// A step below this share of the largest coordinate is lost in rounding.
constexpr double kResolution = 1e-15;
/// Halvings after which a step that raises the energy gives up.
constexpr int kHalvings = 40;

/// The iterate, the gradient there and the next step. What is allocated is so once.
class Iteration {
 public:
  Iteration(const Objective& objective, std::vector<double>& x)
      : f_(objective),
        x_(x),
        size_(3 * objective.masses->size()),
        g_(x.size()),
        p_(size_),
        q_(size_),
        to_(x),
        anderson_(size_) {
    look();
  }

  /// max_i h |g_i| / m_i [m/s]; infinite where the gradient is not finite.
  double residual() const { return residual_; }

  /// Go to the next iterate; false where no step has an effect and does not raise the energy.
  bool advance() {
    f_.matrix->solve(g_.data(), p_.data(), scratch_);
    double step = 0.0;
    double extent = 0.0;
    for (std::size_t a = 0; a < size_; ++a) {
      p_[a] = -p_[a];
      q_[a] = -g_[a];
      step = std::max(step, std::abs(p_[a]));
      extent = std::max(extent, std::abs(x_[a]));
    }
    if (!(step > kResolution * extent)) return false;
    anderson_.next(x_.data(), p_.data(), q_.data(), to_.data());
    if (!gains() && !halve()) return false;
    x_.swap(to_);
    look();
    return true;
  }

  /// Go back to the iterate before.
  void go_back() {
    x_.swap(to_);
    look();
  }

 private:
  bool gains() const {
    double change = 0.0;
    for (const Potential* p : f_.potentials) change += p->energy_change(x_.data(), to_.data());
    return change <= 0.0;
  }

  /// Take the plain step, or a part of it.
  bool halve() {
    double share = 1.0;
    for (int k = 0; k < kHalvings; ++k, share *= 0.5) {
      for (std::size_t a = 0; a < size_; ++a) to_[a] = x_[a] + share * p_[a];
      if (gains()) return true;
    }
    return false;
  }

  void look() {
    std::ranges::fill(g_, 0.0);
    for (const Potential* p : f_.potentials) p->add_gradient(x_.data(), g_.data());
    residual_ = 0.0;
    for (const Index i : f_.matrix->vertices()) {
      const double rate = f_.h * row(g_.data(), i).norm() / (*f_.masses)[i];
      if (!std::isfinite(rate)) {
        residual_ = std::numeric_limits<double>::infinity();
        return;
      }
      residual_ = std::max(residual_, rate);
    }
  }

  const Objective& f_;
  std::vector<double>& x_;
  std::size_t size_;
  std::vector<double> g_, p_, q_, to_;
  Anderson anderson_;
  ConstantMatrix::Scratch scratch_;
  double residual_ = 0.0;
};

}  // namespace

Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const Options& options,
                 const Checkpoint& checkpoint) {
  Iteration iteration(objective, x);
  Outcome outcome;
  const auto end = [&](Status status) {
    outcome.status = status;
    outcome.residual = iteration.residual();
    return outcome;
  };
  for (;;) {
    checkpoint.check();
    if (!std::isfinite(iteration.residual())) {
      if (outcome.iterations > 0) iteration.go_back();
      return end(Status::kOverflow);
    }
    if (iteration.residual() < options.tolerance) return end(Status::kConverged);
    if (outcome.iterations == options.max_iterations) return end(Status::kIterationLimit);
    if (!iteration.advance()) return end(Status::kRoundingFloor);
    ++outcome.iterations;
  }
}

}  // namespace diffcloth::projective
