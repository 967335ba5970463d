#pragma once

#include <atomic>
#include <chrono>
#include <functional>

namespace diffcloth {

/// Thrown to unwind a call that the user has interrupted. The caller's poll knows the reason.
struct Interrupted {};

/// Lets a long computation be interrupted: call check() often.
///
/// One instance is shared by the threads of a call. `poll` is called on the thread that made the
/// call only, at most every 50 ms, and returns true to stop everybody.
class Interrupt {
 public:
  explicit Interrupt(std::function<bool()> poll) : poll_(std::move(poll)) {}

  /// To be called by the thread that made the call.
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

/// What one worker sees of an Interrupt.
class Checkpoint {
 public:
  Checkpoint(Interrupt& interrupt, bool is_caller) : interrupt_(interrupt), is_caller_(is_caller) {}

  void check() const {
    if (is_caller_) interrupt_.poll();
    if (interrupt_.stopped()) throw Interrupted{};
  }

 private:
  Interrupt& interrupt_;
  bool is_caller_;
};

}  // namespace diffcloth
