#pragma once

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <utility>

namespace diffcloth {

/// Phase of a step for timing. kOther is the remainder, so that the phases add up to the total.
enum class Phase : std::uint8_t {
  kDetection,      ///< broad phase and collision detection
  kAssembly,       ///< contacts, gradients and Hessians
  kAnalysis,       ///< symbolic factorization
  kFactorization,  ///< numeric factorization
  kSolve,          ///< triangular solves and conjugate gradients
  kLineSearch,     ///< energies of trial points
  kOther,
};
inline constexpr std::size_t kPhaseCount = 7;
inline constexpr std::array<const char*, kPhaseCount> kPhaseNames{
    "detection", "assembly", "analysis", "factorization", "solve", "line_search", "other"};
using Seconds = std::array<double, kPhaseCount>;

/// Measures the time of one thread by phase: exactly one phase is active at any moment.
class Stopwatch {
 public:
  /// Start a phase; returns the phase that was active.
  Phase enter(Phase phase) {
    const Clock::time_point now = Clock::now();
    seconds_[static_cast<std::size_t>(phase_)] +=
        std::chrono::duration<double>(now - since_).count();
    since_ = now;
    return std::exchange(phase_, phase);
  }

  /// Seconds of all phases up to now.
  const Seconds& read() {
    enter(phase_);
    return seconds_;
  }

  /// Scope of a phase; afterwards the previous phase continues.
  class Scope {
   public:
    Scope(Stopwatch& watch, Phase phase) : watch_(watch), before_(watch.enter(phase)) {}
    ~Scope() { watch_.enter(before_); }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;

   private:
    Stopwatch& watch_;
    Phase before_;
  };

 private:
  using Clock = std::chrono::steady_clock;

  Seconds seconds_{};
  Phase phase_ = Phase::kOther;
  Clock::time_point since_ = Clock::now();
};

}  // namespace diffcloth
