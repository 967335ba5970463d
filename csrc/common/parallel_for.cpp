#include "common/parallel_for.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdlib>
#include <exception>
#include <functional>
#include <mutex>
#include <numeric>
#include <system_error>
#include <thread>
#include <vector>

namespace diffcloth {

namespace {

/// True if a new thread can allocate memory. The test also reserves the memory that its exceptions will
/// need: a failure there would terminate the process instead of raising an error.
bool take_memory() {
  constexpr std::size_t kBytes = std::size_t{1} << 18;
  void* volatile probe = std::malloc(kBytes);  // volatile, to prevent optimization
  if (probe == nullptr) return false;
  std::free(probe);
  return std::uncaught_exceptions() == 0;
}

/// Wait until no other thread is running. Only the caller can detect an interrupt, so it keeps polling
/// while others work.
void wait_for_others(const int& running,  // guarded by the mutex
                     std::mutex& mutex,
                     std::condition_variable& finished,
                     Interrupt& interrupt) {
  std::unique_lock lock(mutex);
  while (running > 0) {
    finished.wait_for(lock, std::chrono::milliseconds(50));
    lock.unlock();
    interrupt.poll();
    lock.lock();
  }
}

}  // namespace

std::vector<Index> most_expensive_first(Index count, std::span<const double> costs) {
  std::vector<Index> order(static_cast<std::size_t>(count));
  std::iota(order.begin(), order.end(), Index{0});
  if (std::ssize(costs) == count) {
    std::ranges::stable_sort(order, std::greater{}, [&](Index i) { return costs[i]; });
  }
  return order;
}

void parallel_for(Index count,
                  int threads,
                  std::span<const double> costs,
                  Interrupt& interrupt,
                  const std::function<void(Index, const Checkpoint&)>& body) {
  const int workers = std::clamp(threads, 1, std::max<int>(count, 1));
  const std::vector<Index> order = most_expensive_first(count, costs);
  std::vector<std::exception_ptr> errors(static_cast<std::size_t>(count));
  std::atomic<Index> next{0};
  std::mutex mutex;
  std::condition_variable finished;
  int running = 0;  // guarded by the mutex

  const auto work = [&](bool is_caller) {
    const Checkpoint checkpoint(interrupt, is_caller);
    for (Index k = next.fetch_add(1); k < count; k = next.fetch_add(1)) {
      const Index i = order[k];
      try {
        checkpoint.check();
        body(i, checkpoint);
      } catch (...) {
        errors[i] = std::current_exception();
      }
    }
  };
  const auto work_beside_caller = [&] {
    if (take_memory()) work(false);
    const std::lock_guard lock(mutex);
    --running;
    finished.notify_one();
  };

  std::vector<std::jthread> pool;  // joined before the variables above are destroyed
  pool.reserve(static_cast<std::size_t>(workers - 1));
  while (std::ssize(pool) + 1 < workers) {
    {
      const std::lock_guard lock(mutex);
      ++running;
    }
    try {
      pool.emplace_back(work_beside_caller);
    } catch (const std::system_error&) {
      // The system has no more threads: the existing ones do the work.
      const std::lock_guard lock(mutex);
      --running;
      break;
    }
  }
  work(true);
  wait_for_others(running, mutex, finished, interrupt);
  pool.clear();

  if (interrupt.stopped()) throw Interrupted{};
  for (const std::exception_ptr& error : errors) {
    if (error) std::rethrow_exception(error);
  }
}

}  // namespace diffcloth
