#include "projective/local_global.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "projective/anderson.h"
#include "solver/stopping.h"

namespace diffcloth::projective {

using solver::stopping::kLocalGlobal;

namespace {

/// Iterate, its gradient and the next step. All memory is allocated once.
class Iteration {
 public:
  Iteration(const LocalGlobalObjective& objective, std::vector<double>& x)
      : f_(objective),
        x_(x),
        size_(3 * objective.masses->size()),
        g_(x.size()),
        g_to_(x.size()),
        p_(size_),
        q_(size_),
        to_(x),
        anderson_(size_) {
    look();
  }

  /// max_i h |g_i| / m_i [m/s]; infinite if the gradient is not finite.
  double residual() const { return residual_; }

  /// Compute the next iterate. Returns false if no step has an effect without raising the energy.
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
    if (!(step > kLocalGlobal.resolution * extent) || idles()) return false;
    anderson_.next(x_.data(), p_.data(), q_.data(), to_.data());
    if (!gains() && !halve()) return false;
    x_.swap(to_);
    look();
    return true;
  }

  /// Restore the previous iterate.
  void go_back() {
    x_.swap(to_);
    look();
  }

 private:
  bool gains() {
    change_ = 0.0;
    for (const Potential* p : f_.potentials) change_ += p->energy_change(x_.data(), to_.data());
    return change_ < 0.0 || (change_ <= noise_ && is_flat());
  }

  /// True if the step to `to` descends, and ends at a point with a smaller slope.
  bool is_flat() {
    f_.gradient(to_, g_to_);
    double slope = 0.0;
    double slope_to = 0.0;
    for (const Index i : f_.matrix->vertices()) {
      const Vec3 step = row(to_.data(), i) - row(x_.data(), i);
      slope += step.dot(row(g_.data(), i));
      slope_to += step.dot(row(g_to_.data(), i));
    }
    return slope < 0.0 && slope_to <= -kLocalGlobal.wolfe_slope * slope;
  }

  bool idles() {
    if (age_++ % kLocalGlobal.energy_age == 0) {
      double energy = 0.0;
      for (const Potential* p : f_.potentials) energy += p->energy(x_.data());
      noise_ = kLocalGlobal.energy_noise * std::abs(energy);
    }
    const bool progress = residual_ < kLocalGlobal.progress * best_ || change_ < -noise_;
    idle_ = progress ? 0 : idle_ + 1;
    best_ = std::min(best_, residual_);
    return idle_ > kLocalGlobal.idle_iterations;
  }

  /// Use the plain step, halved as often as necessary.
  bool halve() {
    double share = 1.0;
    for (int k = 0; k < kLocalGlobal.halvings; ++k, share *= 0.5) {
      for (std::size_t a = 0; a < size_; ++a) to_[a] = x_[a] + share * p_[a];
      if (gains()) return true;
    }
    return false;
  }

  void look() {
    f_.gradient(x_, g_);
    residual_ = f_.largest_rate(g_);
  }

  const LocalGlobalObjective& f_;
  std::vector<double>& x_;
  std::size_t size_;
  std::vector<double> g_, g_to_, p_, q_, to_;
  Anderson anderson_;
  ConstantMatrix::Scratch scratch_;
  double residual_ = 0.0;
  double change_ = -std::numeric_limits<double>::infinity();  // change of energy, last step [J]
  double noise_ = 0.0;  // bound of change_ due to rounding [J]
  double best_ = std::numeric_limits<double>::infinity();
  int age_ = 0;
  int idle_ = 0;
};

}  // namespace

void LocalGlobalObjective::gradient(const std::vector<double>& x, std::vector<double>& g) const {
  std::ranges::fill(g, 0.0);
  for (const Potential* p : potentials) p->add_gradient(x.data(), g.data());
}

double LocalGlobalObjective::largest_rate(const std::vector<double>& force) const {
  double largest = 0.0;
  for (const Index i : matrix->vertices()) {
    const double rate = h * row(force.data(), i).norm() / (*masses)[i];
    if (!std::isfinite(rate)) return std::numeric_limits<double>::infinity();
    largest = std::max(largest, rate);
  }
  return largest;
}

LocalGlobalOutcome minimize(const LocalGlobalObjective& objective,
                            std::vector<double>& x,
                            const LocalGlobalOptions& options,
                            const Checkpoint& checkpoint) {
  Iteration iteration(objective, x);
  LocalGlobalOutcome outcome;
  const auto end = [&](LocalGlobalStatus status) {
    outcome.status = status;
    outcome.residual = iteration.residual();
    return outcome;
  };
  for (;;) {
    checkpoint.check_interrupt();
    if (!std::isfinite(iteration.residual())) {
      if (outcome.iterations > 0) iteration.go_back();
      return end(LocalGlobalStatus::kOverflow);
    }
    if (iteration.residual() < options.tolerance) return end(LocalGlobalStatus::kConverged);
    if (checkpoint.is_late()) return end(LocalGlobalStatus::kTimeLimit);
    if (outcome.iterations == options.max_iterations)
      return end(LocalGlobalStatus::kIterationLimit);
    if (!iteration.advance()) return end(LocalGlobalStatus::kNoProgress);
    ++outcome.iterations;
  }
}

}  // namespace diffcloth::projective
