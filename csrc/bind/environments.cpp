#include "bind/environments.h"

#include <algorithm>
#include <atomic>
#include <chrono>

#include "bind/bind.h"
#include "bind/without_gil.h"
#include "common/parallel_for.h"

namespace diffcloth::bind {

std::vector<Turn> for_environments(std::size_t count,
                                   int threads,
                                   std::span<const double> costs,
                                   const std::function<void(Index, const Checkpoint&)>& body) {
  using Clock = std::chrono::steady_clock;
  std::vector<Turn> turns(count);
  std::atomic<int> begun{0};
  const auto timed = [&](Index i, const Checkpoint& checkpoint) {
    turns[i].place = begun.fetch_add(1);
    const Clock::time_point begin = Clock::now();
    body(i, checkpoint);
    turns[i].seconds = std::chrono::duration<double>(Clock::now() - begin).count();
  };
  Interrupt interrupt([] {
    if (is_abandoned()) return true;
    const nb::gil_scoped_acquire gil;
    return PyErr_CheckSignals() != 0;
  });
  try {
    const WithoutGil nogil;
    parallel_for(static_cast<Index>(count), threads, costs, interrupt, timed);
  } catch (const Interrupted&) {
    throw nb::python_error();  // error set by the signal handler
  }
  return turns;
}

int threads_each(std::size_t count, int threads) {
  // On four threads the factorization of 96 x 96 vertices takes a third of the time; more threads gain
  // little, because the path to the root of the elimination tree is serial.
  constexpr int kMost = 4;
  return std::clamp(threads / std::max(static_cast<int>(count), 1), 1, kMost);
}

}  // namespace diffcloth::bind
