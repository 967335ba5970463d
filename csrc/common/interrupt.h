#pragma once

#include <atomic>
#include <chrono>
#include <functional>

namespace diffcloth {

/// Thrown to unwind a call that the user interrupted. The caller's poll records the reason.
struct Interrupted {};

/// Interrupt of a long computation, which must call check() often.
///
/// One instance is shared by the threads of a call. `poll` is called only on the thread that made the
/// call, at most every 50 ms, and returns true to stop all threads.
class Interrupt {
 public:
  explicit Interrupt(std::function<bool()> poll) : poll_(std::move(poll)) {}

  /// Must be called on the thread that made the call.
  void poll() {
    const auto now = std::chrono::steady_clock::now();
    if (now - last_ < std::chrono::milliseconds(50)) return;
    last_ = now;
    if (poll_ && poll_()) stopped_.store(true);
  }

  bool stopped() const { return stopped_.load(); }

 private:
  std::function<bool()> poll_;
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
  std::atomic<bool> stopped_{false};
};

/// Thrown to unwind a step after its deadline, to the point at which it can end.
struct TimeIsUp {};

/// View of an Interrupt for one worker, with the deadline of a step.
class Checkpoint {
 public:
  Checkpoint(Interrupt& interrupt, bool is_caller)
      : interrupt_(&interrupt), is_caller_(is_caller) {}

  /// Copy with a deadline `seconds` from now; none if infinite.
  Checkpoint with_seconds(double seconds) const {
    constexpr double kForever = 1e9;  // beyond the range of the clock
    Checkpoint other = *this;
    if (seconds < kForever) {
      const std::chrono::duration<double> left(seconds);
      other.deadline_ = Clock::now() + std::chrono::duration_cast<Clock::duration>(left);
    }
    return other;
  }

  /// @throws Interrupted, TimeIsUp
  void check() const {
    check_interrupt();
    if (is_late()) throw TimeIsUp{};
  }

  /// @throws Interrupted
  void check_interrupt() const {
    if (is_caller_) interrupt_->poll();
    if (interrupt_->stopped()) throw Interrupted{};
  }

  bool is_late() const { return deadline_ < kNever && Clock::now() > deadline_; }

  /// Remove the expired deadline, so that the step can end in order; solves do not continue.
  void stop_clock() {
    deadline_ = kNever;
    is_up_ = true;
  }

  /// True once stop_clock() has been called.
  bool is_up() const { return is_up_; }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr Clock::time_point kNever = Clock::time_point::max();

  Interrupt* interrupt_;
  bool is_caller_;
  Clock::time_point deadline_ = kNever;
  bool is_up_ = false;
};

}  // namespace diffcloth
