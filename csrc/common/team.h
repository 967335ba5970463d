#pragma once

#include <algorithm>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

#include "common/types.h"

namespace diffcloth {

/// Threads that share the work on one environment: the caller's, and helpers.
///
/// Helpers start with the first loop that has work for them, sleep between loops, and end with the team.
/// If the system provides fewer threads, fewer do the work. Only one thread at a time may call run().
class Team {
 public:
  explicit Team(int size) : size_(std::max(size, 1)) {}
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  /// Maximum number of threads of a loop, including the caller's.
  int size() const { return size_; }

  /// Processor time that the helpers have spent on all loops so far [s].
  double helpers_seconds() const { return helpers_seconds_; }

  /// Completed works of a loop, by index.
  using Done = std::vector<char>;

  /// True if work i may begin; must be true once all works below i are done.
  using Ready = std::function<bool(Index i, const Done& done)>;

  /// Executes work i as a member in [0, size); must not throw.
  using Body = std::function<void(Index i, int member)>;

  /// Run body(i, member) for i in [0, count), always the lowest i that is ready. Works without a
  /// dependency between them must write to different memory.
  void run(Index count, const Ready& ready, const Body& body);

 private:
  void start();
  void help(int member);
  void work(std::unique_lock<std::mutex>& lock, int member);
  Index find_ready();

  int size_;
  std::vector<std::jthread> helpers_;
  bool started_ = false;

  std::mutex mutex_;  // guards everything below
  std::condition_variable changed_;
  const Ready* ready_ = nullptr;
  const Body* body_ = nullptr;
  Done taken_;
  Done done_;
  Index first_ = 0;  // all indices below are taken
  Index left_ = 0;   // number of works not yet done
  bool ends_ = false;
  double helpers_seconds_ = 0.0;
};

}  // namespace diffcloth
