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
/// Helpers begin with the first loop that has work for them, sleep between loops, and end with the
/// team. Where the system refuses to make as many, fewer do the work. One thread at a time calls
/// run().
class Team {
 public:
  explicit Team(int size) : size_(std::max(size, 1)) {}
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  /// Most threads of a loop, the caller's included.
  int size() const { return size_; }

  /// Processor time that the helpers have spent on all loops so far [s].
  double helpers_seconds() const { return helpers_seconds_; }

  /// What is done of a loop, by index.
  using Done = std::vector<char>;

  /// Whether work i may begin; true once all indices below i are done.
  using Ready = std::function<bool(Index i, const Done& done)>;

  /// Does work i as a member in [0, size), and must not throw.
  using Body = std::function<void(Index i, int member)>;

  /// Run body(i, member) for i in [0, count), always the lowest i that may begin. Works of which
  /// neither has to wait for the other must not share what they write.
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
  Index first_ = 0;  // all below are taken
  Index left_ = 0;   // not yet done
  bool ends_ = false;
  double helpers_seconds_ = 0.0;
};

}  // namespace diffcloth
