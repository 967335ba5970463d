#include "solver/newton.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/ccd.h"

namespace diffcloth::solver {
namespace {

using contact::Candidate;
using contact::Contact;
using contact::Curvature;
using Clock = std::chrono::steady_clock;

/// Adds the time until its end to one phase.
class Timer {
 public:
  Timer(Seconds& seconds, Phase phase)
      : slot_(seconds[static_cast<std::size_t>(phase)]), start_(Clock::now()) {}
  ~Timer() { slot_ += std::chrono::duration<double>(Clock::now() - start_).count(); }
  Timer(const Timer&) = delete;
  Timer& operator=(const Timer&) = delete;

 private:
  double& slot_;
  Clock::time_point start_;
};

/// A chord step (an old factor) is taken while it shrinks the step by this much.
constexpr double kChordContraction = 0.1;
/// A factor vouches for the Hessian's sign at points nearer than this [m/s].
constexpr double kNearFactor = 1e-4;
/// First shift of an indefinite Hessian, as a share of M/h^2, and how it grows and shrinks.
constexpr double kFirstShift = 0.1;
constexpr double kShiftGrowth = 4.0;
constexpr double kShiftDecay = 0.3;
/// After an indefinite Hessian the elements are projected: this often, and as long as steps are
/// larger than kFar [m/s]. Then the Hessian is shifted, which converges where projection crawls.
constexpr int kProjections = 3;
constexpr double kFar = 0.1;
/// Sufficient decrease, and the slope that replaces it where the change drowns in rounding.
constexpr double kArmijo = 1e-4;
constexpr double kWolfeSlope = 0.8;
/// Relative size of an energy change that rounding can fake.
constexpr double kEnergyNoise = 1e-11;
constexpr int kBacktracks = 40;
/// A step below this share of the coordinates is lost in their rounding.
constexpr double kResolution = 1e-15;
/// Iterations without progress after which the float64 floor is considered reached.
constexpr int kStagnation = 5;
constexpr double kNearFloor = 1e-4;  // [m/s]
/// A prescribed motion is stuck when this many iterations move it by less than this fraction.
constexpr int kStuckIterations = 20;
constexpr double kStuckProgress = 1e-3;
/// A joint step that leaves more than this share of the motion is followed by a relaxation.
constexpr double kStopped = 0.5;

double dot(const std::vector<double>& a, const std::vector<double>& b) {
  double sum = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

/// Largest displacement of a vertex along a coordinate axis; NaN counts as infinite.
double largest(const std::vector<double>& p) {
  double result = 0.0;
  for (const double value : p) {
    if (!(std::abs(value) <= result)) result = std::abs(value);
  }
  return std::isnan(result) ? std::numeric_limits<double>::infinity() : result;
}

class Minimizer {
 public:
  Minimizer(const Objective& f,
            std::vector<double>& x,
            const PrescribedMotion& motion,
            const Context& context)
      : f_(f), x_(x), motion_(motion), context_(context), p_(x.size(), 0.0) {}

  Outcome run(const std::vector<double>* guess);

 private:
  bool start_from(const std::vector<double>& guess);
  bool arrive();
  void relax();
  bool joint_step(const std::vector<double>& ends, double& remaining);
  void descend();

  bool take_direction();
  bool factor(Hessian& hessian, double shift);
  void solve(const linalg::CholeskyFactor& factor);
  bool chord();
  bool near_factor() const;
  bool exact_direction();
  void positive_direction();
  void shifted_direction();
  double change(const std::vector<double>& to);
  bool search();
  bool escape_saddle();

  void detect(const std::vector<double>& to);
  double safe_fraction(const std::vector<double>& to) const;
  void refresh();
  void record() {
    if (context_.path != nullptr) context_.path->push_back(x_);
  }
  std::vector<double> moved(double alpha) const {
    std::vector<double> result(x_);
    for (std::size_t i = 0; i < result.size(); ++i) result[i] += alpha * p_[i];
    return result;
  }

  enum class Mode : std::uint8_t { kExact, kPositive, kShifted };

  const Objective& f_;
  std::vector<double>& x_;
  const PrescribedMotion& motion_;
  const Context& context_;
  Outcome out_;

  std::vector<double> p_;
  std::vector<double> g_;
  std::vector<Candidate> candidates_;
  std::vector<Contact> contacts_;
  std::vector<double> energies_, trial_energies_;

  Mode mode_ = Mode::kExact;
  bool chord_allowed_ = false;
  bool limited_ = false;  // whether collision detection cut the last step short
  double last_step_ = std::numeric_limits<double>::infinity();
  int indefinite_ = 0;  // exact Hessians that were not positive definite
  int skip_exact_ = 0;  // iterations for which the exact Hessian is not tried
  double shift_ = kFirstShift;
  std::shared_ptr<linalg::CholeskyFactor> shifted_factor_;
};

void Minimizer::detect(const std::vector<double>& to) {
  if (context_.broad_phase == nullptr) return;
  const Timer timer(*context_.seconds, Phase::kDetection);
  context_.candidates->find(x_.data(), to.data(), f_.contact->reach(), *context_.scratch,
                            candidates_);
}

double Minimizer::safe_fraction(const std::vector<double>& to) const {
  if (context_.broad_phase == nullptr) return 1.0;
  const Timer timer(*context_.seconds, Phase::kDetection);
  double alpha = 1.0;
  for (const Candidate& pair : candidates_) {
    alpha = std::min(alpha, contact::safe_step(
                                pair.kind, contact::corners(pair.vertices, x_.data()),
                                contact::corners(pair.vertices, to.data()), f_.contact->xi(pair)));
    if (alpha == 0.0) break;
  }
  return alpha;
}

/// Contacts and gradient at x_, from the current candidates.
void Minimizer::refresh() {
  const Timer timer(*context_.seconds, Phase::kAssembly);
  if (f_.contact != nullptr) f_.contact->find(candidates_, x_.data(), contacts_);
  f_.gradient(x_.data(), contacts_, g_);
}

bool Minimizer::start_from(const std::vector<double>& guess) {
  if (motion_.portions() > 1) return false;
  // Where inertia alone would collapse the cloth (long steps, forces on light vertices), the start
  // of the step with pins at their ends is the better place to begin.
  std::vector<double> held = guess;
  for (Index i = 0; i < f_.cloth_vertex_count; ++i) {
    if (f_.is_free(i)) Eigen::Map<Vec3>(held.data() + 3 * i) = row(x_.data(), i);
  }
  if (f_.energy(guess.data(), {}) > f_.energy(held.data(), {})) return false;
  detect(guess);
  if (safe_fraction(guess) < 1.0) return false;
  if (f_.contact != nullptr) {
    f_.contact->find(candidates_, guess.data(), contacts_);
    if (!contacts_.empty()) return false;
  }
  x_ = guess;
  record();
  return true;
}

bool Minimizer::factor(Hessian& hessian, double shift) {
  const Timer timer(*context_.seconds, Phase::kFactorization);
  if (shift > 0.0) {
    const linalg::BlockPattern& pattern = hessian.assembly->merged.pattern;
    for (Index i = 0; i < f_.cloth_vertex_count; ++i) {
      Eigen::Map<Mat3>(hessian.blocks.data() +
                       9 * static_cast<std::ptrdiff_t>(pattern.column_start()[i]))
          .diagonal()
          .array() += shift * f_.metric[i] / (f_.h * f_.h);
    }
  }
  shifted_factor_ = std::make_shared<linalg::CholeskyFactor>(hessian.assembly->analysis);
  return shifted_factor_->compute(hessian.blocks.data());
}

/// p_ = -factor^-1 g_ at the free vertices, zero elsewhere.
void Minimizer::solve(const linalg::CholeskyFactor& factor) {
  const Timer timer(*context_.seconds, Phase::kSolve);
  std::fill(p_.begin(), p_.end(), 0.0);
  factor.solve(g_.data(), p_.data());
  for (double& value : p_) value = -value;
}

/// One step of the joint Newton method on the free vertices and the prescribed motion:
/// H_xx p = -(g + H_xo do), both moved by the same collision-free fraction.
bool Minimizer::joint_step(const std::vector<double>& ends, double& remaining) {
  std::vector<double> d(x_.size(), 0.0);
  for (Index i = 0; i < f_.vertex_count; ++i) {
    if (f_.is_free(i)) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) d[a] = ends[a] - x_[a];
  }
  refresh();
  Hessian hessian;
  {
    const Timer timer(*context_.seconds, Phase::kAssembly);
    hessian = assemble(f_, x_.data(), contacts_, Curvature::kPositive);
    add_prescribed_product(f_, hessian, x_.data(), contacts_, Curvature::kPositive, d.data(),
                           g_.data());
  }
  // Positive by construction: M/h^2 plus positive semi-definite parts.
  if (!factor(hessian, 0.0)) return false;
  solve(*shifted_factor_);
  for (std::size_t i = 0; i < p_.size(); ++i) p_[i] += d[i];

  const std::vector<double> to = moved(1.0);
  detect(to);
  const double alpha = safe_fraction(to);
  x_ = moved(alpha);
  if (alpha == 1.0) {
    for (Index i = 0; i < f_.vertex_count; ++i) {
      if (f_.is_free(i)) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) x_[a] = ends[a];
    }
  }
  record();
  remaining *= 1.0 - alpha;
  return true;
}

/// One step of the free vertices alone: reopens gaps that a blocked joint step has closed.
void Minimizer::relax() {
  refresh();
  positive_direction();
  search();
}

/// Move the prescribed vertices to their ends. False when the motion is infeasible.
bool Minimizer::arrive() {
  const int portions = motion_.portions();
  std::vector<double> ends(x_);
  for (int k = 0; k < portions; ++k) {
    motion_.end_of_portion(k, ends.data());
    bool arrived = true;
    for (Index i = 0; i < f_.vertex_count && arrived; ++i) {
      if (!f_.is_free(i)) arrived = row(x_.data(), i) == row(ends.data(), i);
    }
    if (arrived) continue;
    double remaining = 1.0;
    double checked = 1.0;
    for (int iteration = 0; remaining > 0.0; ++iteration) {
      context_.checkpoint->check();
      if (iteration > 0 && iteration % kStuckIterations == 0) {
        if (checked - remaining < kStuckProgress || iteration >= context_.options.max_iterations) {
          out_.motion_fraction = (k + 1.0 - remaining) / portions;
          return false;
        }
        checked = remaining;
      }
      ++out_.iterations;
      const double before = remaining;
      if (!joint_step(ends, remaining)) {
        out_.motion_fraction = (k + 1.0 - remaining) / portions;
        return false;
      }
      if (remaining > kStopped * before) relax();
    }
  }
  return true;
}

bool Minimizer::chord() {
  if (!chord_allowed_ || out_.factor == nullptr) return false;
  solve(*out_.factor);
  if (!(largest(p_) <= kChordContraction * last_step_)) return false;
  mode_ = Mode::kExact;
  return true;
}

/// Whether the last exact factor was made so close by that the Hessian here is as definite: chord
/// steps may have come far from it, into a saddle.
bool Minimizer::near_factor() const {
  double drift = 0.0;
  for (std::size_t i = 0; i < x_.size(); ++i) {
    drift = std::max(drift, std::abs(x_[i] - out_.factored_at[i]));
  }
  return drift < kNearFactor * f_.h;
}

/// Newton direction with the exact Hessian. False when it is not positive definite.
bool Minimizer::exact_direction() {
  Hessian hessian;
  {
    const Timer timer(*context_.seconds, Phase::kAssembly);
    hessian = assemble(f_, x_.data(), contacts_, Curvature::kExact);
  }
  if (!factor(hessian, 0.0)) {
    ++indefinite_;
    return false;
  }
  out_.factor = shifted_factor_;
  out_.factored_at = x_;
  mode_ = Mode::kExact;
  solve(*out_.factor);
  return true;
}

void Minimizer::positive_direction() {
  Hessian hessian;
  {
    const Timer timer(*context_.seconds, Phase::kAssembly);
    hessian = assemble(f_, x_.data(), contacts_, Curvature::kPositive);
  }
  mode_ = Mode::kPositive;
  if (!factor(hessian, 0.0)) {
    shifted_direction();  // an element lost its sign to rounding
    return;
  }
  solve(*shifted_factor_);
}

void Minimizer::shifted_direction() {
  mode_ = Mode::kShifted;
  for (;; shift_ *= kShiftGrowth) {
    context_.checkpoint->check();
    Hessian hessian;
    {
      const Timer timer(*context_.seconds, Phase::kAssembly);
      hessian = assemble(f_, x_.data(), contacts_, Curvature::kExact);
    }
    if (factor(hessian, shift_)) break;
  }
  solve(*shifted_factor_);
  shift_ = std::max(kShiftDecay * shift_, 1e-6);
}

/// Fill p_ with the next direction. False when the exact Hessian is indefinite where the gradient
/// vanishes: a saddle.
bool Minimizer::take_direction() {
  if (chord()) return true;
  const bool far = indefinite_ <= kProjections || last_step_ > kFar * f_.h;
  if (skip_exact_ > 0) {
    --skip_exact_;
  } else {
    if (exact_direction()) return true;
    skip_exact_ = far ? 1 : 0;
  }
  if (far) {
    positive_direction();
  } else {
    shifted_direction();
  }
  if (largest(p_) >= f_.h * context_.options.tolerance) return true;
  skip_exact_ = 0;
  return exact_direction();
}

/// Objective at `to` minus that at x_, from the current candidates.
double Minimizer::change(const std::vector<double>& to) {
  const Timer timer(*context_.seconds, Phase::kLineSearch);
  if (f_.contact != nullptr) f_.contact->energies(candidates_, to.data(), trial_energies_);
  return f_.energy_change(x_.data(), energies_, to.data(), trial_energies_);
}

/// Move along p_ by the largest collision-free fraction that decreases the objective. False when
/// rounding leaves nothing to gain.
bool Minimizer::search() {
  std::vector<double> to = moved(1.0);
  detect(to);
  const double safe = safe_fraction(to);
  limited_ = safe < 1.0;
  const double slope = dot(g_, p_);
  if (f_.contact != nullptr) f_.contact->energies(candidates_, x_.data(), energies_);
  const double noise = kEnergyNoise * std::abs(f_.energy(x_.data(), energies_));

  double alpha = safe;
  chord_allowed_ = false;
  for (int backtrack = 0; backtrack < kBacktracks; ++backtrack, alpha *= 0.5) {
    context_.checkpoint->check();
    if (alpha < 1.0) to = moved(alpha);
    const double gain = change(to);
    const bool decreased = gain <= kArmijo * alpha * slope;
    if (!decreased && !(std::abs(gain) <= noise)) continue;

    x_.swap(to);
    std::vector<double> g_before = g_;
    refresh();
    if (!decreased && !(dot(g_, p_) <= kWolfeSlope * std::abs(slope))) {
      x_.swap(to);
      g_.swap(g_before);
      if (f_.contact != nullptr) f_.contact->find(candidates_, x_.data(), contacts_);
      continue;
    }
    record();
    chord_allowed_ = mode_ == Mode::kExact && alpha == 1.0;
    return true;
  }
  return false;
}

/// Leave a saddle along the most negative direction of the Hessian, found by inverse iteration on
/// the shifted matrix from a fixed start, with a fixed sign.
bool Minimizer::escape_saddle() {
  constexpr int kInverseIterations = 30;
  shifted_direction();
  std::vector<double> d(x_.size(), 0.0);
  std::uint32_t seed = 1;
  for (Index i = 0; i < f_.cloth_vertex_count; ++i) {
    if (!f_.is_free(i)) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) {
      seed = seed * 1664525U + 1013904223U;
      d[a] = static_cast<double>(seed >> 8) / (1U << 24) - 0.5;
    }
  }
  std::vector<double> b(d.size(), 0.0);
  for (int k = 0; k < kInverseIterations; ++k) {
    for (Index i = 0; i < f_.cloth_vertex_count; ++i) {
      for (Index a = 3 * i; a < 3 * i + 3; ++a) b[a] = f_.metric[i] * d[a];
    }
    shifted_factor_->solve(b.data(), d.data());
    const double size = largest(d);
    for (double& value : d) value /= size;
  }
  std::vector<double> product;
  f_.hessian_product(x_.data(), contacts_, d.data(), product);
  if (!(dot(d, product) < 0.0)) return false;
  // The largest component decides the sign; ties go to the first.
  const auto top = std::ranges::max_element(d, {}, [](double value) { return std::abs(value); });
  // The distance that a speed of 1 m/s covers in a step: the search shortens it where needed.
  const double length = f_.h * (*top < 0.0 ? -1.0 : 1.0);
  for (std::size_t i = 0; i < d.size(); ++i) p_[i] = length * d[i];

  std::vector<double> to = moved(1.0);
  detect(to);
  double alpha = safe_fraction(to);
  if (f_.contact != nullptr) f_.contact->energies(candidates_, x_.data(), energies_);
  for (int backtrack = 0; backtrack < kBacktracks; ++backtrack, alpha *= 0.5) {
    to = moved(alpha);
    if (change(to) < 0.0) {
      x_ = std::move(to);
      record();
      refresh();
      chord_allowed_ = false;
      skip_exact_ = 0;
      return true;
    }
  }
  return false;
}

void Minimizer::descend() {
  const double tolerance = context_.options.tolerance;
  double best = std::numeric_limits<double>::infinity();
  int stagnant = 0;
  for (int iteration = 0; iteration < context_.options.max_iterations; ++iteration) {
    context_.checkpoint->check();
    ++out_.iterations;
    if (!take_direction()) {
      if (!escape_saddle()) return;
      best = std::numeric_limits<double>::infinity();
      continue;
    }
    const double step = largest(p_);
    if (mode_ == Mode::kExact) out_.residual = step / f_.h;
    limited_ = false;
    const bool moved_on = step > kResolution * largest(x_) && search();
    // Such a step descends unless rounding is in the way, and then it has nowhere better to go.
    if (mode_ == Mode::kExact && step < f_.h * tolerance && !limited_) {
      if (near_factor() || exact_direction()) {
        out_.status = Status::kConverged;
        return;
      }
      if (!escape_saddle()) return;
      best = std::numeric_limits<double>::infinity();
      continue;
    }
    if (!moved_on) {
      // A chord step may fail where a fresh factor succeeds, a projection where a shift does.
      last_step_ = 0.0;
      if (mode_ == Mode::kExact && out_.factored_at != x_) continue;
      skip_exact_ = 0;
      if (mode_ != Mode::kExact && indefinite_ <= kProjections) {
        indefinite_ = kProjections + 1;
        continue;
      }
      return;
    }
    last_step_ = step;
    if (mode_ == Mode::kExact) {
      stagnant = step < 0.9 * best ? 0 : stagnant + 1;
      best = std::min(best, step);
      // Only near the floor: far from it, a growing step is ordinary.
      if (stagnant >= kStagnation && step / f_.h < kNearFloor) return;
    }
  }
}

Outcome Minimizer::run(const std::vector<double>* guess) {
  record();
  if (guess == nullptr || !start_from(*guess)) {
    detect(x_);
    if (!arrive()) {
      out_.status = Status::kInfeasibleMotion;
      refresh();
      out_.contacts = contacts_;
      return std::move(out_);
    }
  }
  refresh();
  descend();
  out_.contacts = contacts_;
  return std::move(out_);
}

}  // namespace

Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const PrescribedMotion& motion,
                 const std::vector<double>* guess,
                 const Context& context) {
  return Minimizer(objective, x, motion, context).run(guess);
}

std::shared_ptr<const linalg::CholeskyFactor> factor_exact(const Objective& objective,
                                                           const double* x,
                                                           const std::vector<Contact>& contacts) {
  const Hessian hessian = assemble(objective, x, contacts, Curvature::kExact);
  auto factor = std::make_shared<linalg::CholeskyFactor>(hessian.assembly->analysis);
  if (!factor->compute(hessian.blocks.data())) return nullptr;
  return factor;
}

std::vector<Contact> contacts_at(const Objective& objective,
                                 const double* x,
                                 const contact::BroadPhase* broad_phase,
                                 contact::BroadPhase::Scratch* scratch) {
  std::vector<Contact> contacts;
  if (objective.contact == nullptr || broad_phase == nullptr) return contacts;
  std::vector<Candidate> candidates;
  broad_phase->find(x, x, objective.contact->reach(), *scratch, candidates);
  objective.contact->find(candidates, x, contacts);
  return contacts;
}

}  // namespace diffcloth::solver
