#include "solver/direction.h"

#include <algorithm>
#include <cmath>

#include "solver/stopping.h"

namespace diffcloth::solver {

using stopping::kDirections;

void Directions::make_room() {
  // A large factor is seldom useful: if the next factorization fails, damped steps follow, which lead
  // away.
  if (last_.factor && last_.factor->bytes() > walk_.context.options.large_factor) last_ = {};
}

Factor Directions::factor(const linalg::BlockValues& A, bool doubts) {
  SinglePrecision& seen = walk_.context.single;
  linalg::Verdict verdict = linalg::Verdict::kUnclear;
  Factor single = walk_.system.factor(A, linalg::Precision::kSingle, verdict);
  const bool believed = seen.was_right && !seen.was_wrong && !doubts;
  if (single || (verdict == linalg::Verdict::kIndefinite && believed)) return single;
  Factor result = walk_.system.factor_in_doubles(A);
  seen.was_wrong = seen.was_wrong || result != nullptr;
  seen.was_right = seen.was_right || (verdict == linalg::Verdict::kIndefinite && !result);
  return result;
}

bool Directions::refactor(linalg::BlockMatrix& H) {
  make_room();
  Factor factor = this->factor(H, false);
  if (!factor) {
    ++walk_.context.counts->negative_curvature;
    return false;
  }
  factor = solve_downhill(std::move(factor), H);
  if (!factor) {
    ++walk_.context.counts->negative_curvature;
    return false;
  }
  ++walk_.context.counts->exact;
  confirmed_ = factor->precision() == linalg::Precision::kDouble;
  last_ = {
      .factor = std::move(factor),
      .hessian = confirmed_ ? nullptr : std::make_shared<const linalg::BlockValues>(std::move(H))};
  return true;
}

Factor Directions::solve_downhill(Factor factor, const linalg::BlockMatrix& A) {
  solve(*factor, A);
  slope_ = dot(walk_.g(), p_);
  if (slope_ <= 0.0 || factor->precision() == linalg::Precision::kDouble) return factor;
  // Rounding in single precision: with a positive definite matrix, the direction would descend.
  walk_.context.single.was_wrong = true;
  factor = nullptr;  // never two at once
  factor = walk_.system.factor_in_doubles(A);
  if (!factor) return nullptr;
  solve(*factor, A);
  slope_ = dot(walk_.g(), p_);
  return factor;
}

void Directions::solve(const linalg::CholeskyFactor& factor, const linalg::BlockValues& A) {
  walk_.system.solve(factor, walk_.g(), p_);
  if (factor.precision() == linalg::Precision::kSingle && is_far()) {
    walk_.system.refine(factor, A, walk_.g(), p_);
  }
}

bool Directions::chord() {
  walk_.system.solve(*last_.factor, walk_.g(), p_);
  if (!chord_allowed_ || !(walk_.displacement(p_) <= kDirections.chord_contraction * last_step_))
    return false;
  ++walk_.context.counts->chord;
  return true;
}

bool Directions::is_near() const {
  if (std::isinf(last_step_)) return true;
  return chord_allowed_ && last_step_ <= kDirections.near * walk_.f.length;
}

double Directions::operations_per_entry() const {
  const linalg::CholeskyAnalysis& analysis = *last_.factor->analysis();
  return analysis.flops() / static_cast<double>(analysis.nonzeros());
}

bool Directions::is_dear() const {
  return last_.factor != nullptr && operations_per_entry() > walk_.context.options.dear_factor;
}

bool Directions::is_far() const {
  return walk_.displacement(p_) > kDirections.near * walk_.f.length;
}

double Directions::curvature_along(const linalg::BlockMatrix& H) const {
  std::vector<double> z;
  walk_.f.coordinates->take_rows(p_, z);
  std::vector<double> Hz(z.size(), 0.0);
  H.add_product(z.data(), Hz.data());
  return dot(z, Hz);
}

bool Directions::iterate(const linalg::BlockMatrix& H, bool& indefinite) {
  if (last_.factor->analysis()->flops() < kDirections.cheap_factor) return false;
  if (!is_near() && !(chord_allowed_ && is_dear())) return false;
  double forcing = kDirections.forcing;
  int iterations = kDirections.iterations;
  if (is_dear()) {
    // Far from the solution, the remaining error of the direction must be no longer than it may be near
    // there.
    const double far = walk_.displacement(p_) / (kDirections.near * walk_.f.length);
    forcing = kDirections.forcing_of_expensive / std::max(far, 1.0);
    const auto worth =
        static_cast<int>(operations_per_entry() / kDirections.operations_per_iteration);
    iterations = std::max(kDirections.iterations, worth);
  }
  const linalg::Convergence result =
      walk_.system.solve(H, *last_.factor, walk_.g(), forcing, iterations, p_);
  indefinite = result == linalg::Convergence::kNegativeCurvature;
  if (result != linalg::Convergence::kConverged) return false;
  ++walk_.context.counts->exact;
  return true;
}

bool Directions::project() {
  last_ = {};
  confirmed_ = false;
  const linalg::BlockMatrix P =
      walk_.system.assemble(walk_.x().data(), Curvature::kPositive, walk_.g());
  const Factor factor = walk_.system.factor(P);
  if (!factor) return false;
  ++walk_.context.counts->projected;
  walk_.system.solve(*factor, walk_.g(), p_);
  return true;
}

bool Directions::certify() {
  // A nearby factor is of no use if the Hessian is indefinite: the point is a saddle.
  last_ = {};
  last_ = walk_.system.certify(walk_.x().data(), walk_.g(), p_);
  confirmed_ = true;
  if (last_.factor && last_.hessian == nullptr) walk_.context.single.was_wrong = true;
  ++(last_.factor ? walk_.context.counts->exact : walk_.context.counts->negative_curvature);
  return last_.factor != nullptr;
}

bool Directions::confirm() {
  if (!confirmed_) {
    walk_.system.confirm(last_, walk_.g(), p_);
    confirmed_ = true;
    if (last_.hessian == nullptr) walk_.context.single.was_wrong = true;
    if (!last_.factor) ++walk_.context.counts->negative_curvature;
  }
  return last_.factor != nullptr;
}

void Directions::leave() {
  last_.hessian = nullptr;
  confirmed_ = false;
}

std::optional<Directions::Direction> Directions::next() {
  leave();
  const bool nearby = s_ == 0.0 && last_.factor != nullptr;
  const double* x = walk_.x().data();
  if (nearby && chord()) return Direction{.kind = Kind::kChord, .first = 1.0};
  const bool has_duals = walk_.f.has_duals(x);
  const Curvature curvature = has_duals ? Curvature::kPrimalDual : Curvature::kExact;
  linalg::BlockMatrix H = walk_.system.assemble(x, curvature, walk_.g());
  if (s_ == 0.0) {
    bool indefinite = false;
    if (nearby && iterate(H, indefinite)) return Direction{.kind = Kind::kIterated, .first = 1.0};
    if (indefinite) {
      ++walk_.context.counts->negative_curvature;
    } else if (refactor(H)) {
      if (!has_duals) return Direction{.kind = Kind::kFactored, .first = 1.0};
      leave();  // not a factor of the exact Hessian
      return Direction{.kind = Kind::kPrimalDual, .first = 1.0};
    }
    s_ = kDirections.first_share;
  }
  return damp(H, walk_.system.assemble(x, Curvature::kPositive, walk_.g()));
}

std::optional<Directions::Direction> Directions::next_extrapolated() {
  leave();
  const double* x = walk_.x().data();
  linalg::BlockMatrix H = walk_.system.assemble_extrapolated(x, Curvature::kExact, walk_.g());
  if (refactor(H)) return Direction{.kind = Kind::kExtrapolated, .first = 1.0};
  if (s_ == 0.0) s_ = kDirections.first_share;
  return damp(H, walk_.system.assemble_extrapolated(x, Curvature::kPositive, walk_.g()));
}

bool Directions::descend(const linalg::BlockMatrix& A, bool doubts) {
  Factor factor = this->factor(A, doubts);
  return factor && solve_downhill(std::move(factor), A);
}

std::optional<Directions::Direction> Directions::damp(const linalg::BlockMatrix& H,
                                                      const linalg::BlockMatrix& P) {
  make_room();
  double curvature = 0.0;  // curvature of the exact quadratic model along p
  for (;;) {
    walk_.context.checkpoint->check();
    linalg::BlockMatrix A = H;
    A.blend(P, s_);
    if (descend(A, s_ > kDirections.first_share)) {
      curvature = curvature_along(H);
      const double positive = (-(1.0 + s_) * slope_ - curvature) / s_;
      if (-slope_ >= kDirections.held * positive || !is_far()) break;
      s_ *= kDirections.failure_growth;
    } else {
      if (s_ > kDirections.largest_share) return std::nullopt;
      s_ = std::max(kDirections.first_share, kDirections.failure_growth * s_);
    }
  }
  ++walk_.context.counts->projected;
  // The minimum of the quadratic model; the largest growth if its curvature is negative.
  const double best = curvature > 0.0 ? -slope_ / curvature : kDirections.largest_growth;
  return Direction{
      .kind = Kind::kDamped,
      .first = best > kDirections.worth_growing ? std::min(best, kDirections.largest_growth) : 1.0};
}

void Directions::learn(const Direction& direction, const Search& search) {
  last_step_ = walk_.displacement(p_);
  chord_allowed_ = direction.kind != Kind::kDamped && search.alpha == 1.0;
  if (direction.kind != Kind::kDamped) return;
  const double promised = slope_ * search.alpha * (1.0 - 0.5 * std::min(search.alpha, 1.0));
  if (search.backtracks == 0 && search.gain <= kDirections.good_gain * promised) {
    s_ *= kDirections.decay;
    if (s_ < kDirections.no_share) s_ = 0.0;
  } else if (search.backtracks >= kDirections.many_backtracks ||
             (search.measured && search.gain > kDirections.poor_gain * promised)) {
    s_ = std::min(kDirections.growth * s_, kDirections.full_share);
  }
}

bool Directions::retry(Kind kind) {
  last_step_ = 0.0;
  chord_allowed_ = false;
  switch (kind) {
    case Kind::kChord:
    case Kind::kIterated:
    case Kind::kExtrapolated:
      last_ = {};
      return true;
    case Kind::kFactored:
    case Kind::kPrimalDual:
      s_ = kDirections.first_share;
      return true;
    case Kind::kDamped:
      s_ *= kDirections.failure_growth;
      return s_ <= kDirections.largest_share;
  }
  __builtin_unreachable();
}

void Directions::restart() {
  last_step_ = std::numeric_limits<double>::infinity();
  chord_allowed_ = false;
  s_ = 0.0;
}

}  // namespace diffcloth::solver
