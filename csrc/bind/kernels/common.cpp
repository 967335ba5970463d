#include <algorithm>
#include <atomic>
#include <chrono>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "bind/environments.h"
#include "bind/kernels/kernels.h"
#include "common/team.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind
using Clock = std::chrono::steady_clock;

void rest() { std::this_thread::sleep_for(std::chrono::milliseconds(1)); }

/// Run `count` bodies, and return how many of them each thread executed, the caller's first.
///
/// Bodies on the caller's thread return once another thread has begun. Bodies on other threads continue
/// for `seconds`, unless they are interrupted; `failing` ones then throw.
std::vector<int> run_environments(int count,
                                  int threads,
                                  double seconds,
                                  const std::vector<int>& failing) {
  const std::thread::id caller = std::this_thread::get_id();
  std::vector<std::thread::id> taken_by(static_cast<std::size_t>(count));
  std::atomic<int> others{0};
  const auto end = Clock::now() + std::chrono::duration<double>(seconds);
  for_environments(static_cast<std::size_t>(count), threads, {},
                   [&](Index i, const Checkpoint& checkpoint) {
                     const bool is_caller = std::this_thread::get_id() == caller;
                     taken_by[i] = std::this_thread::get_id();
                     if (!is_caller) ++others;
                     while (Clock::now() < end && !(is_caller && others.load() > 0)) {
                       checkpoint.check();
                       rest();
                     }
                     if (std::ranges::find(failing, i) != failing.end()) {
                       throw std::invalid_argument("environment " + std::to_string(i));
                     }
                   });

  std::vector<std::thread::id> order{caller};
  std::vector<int> counts{0};
  for (const std::thread::id id : taken_by) {
    const auto at = std::ranges::find(order, id);
    const auto k = static_cast<std::size_t>(at - order.begin());
    if (at == order.end()) {
      order.push_back(id);
      counts.push_back(0);
    }
    ++counts[k];
  }
  return counts;
}

/// Run works on a team, and return the member that executed each, and the order in which they began.
///
/// @param before  for each work the lower indices it waits for
std::vector<std::pair<int, int>> run_team(const std::vector<std::vector<int>>& before,
                                          int threads,
                                          double seconds,
                                          int repeats) {
  const nb::gil_scoped_release nogil;
  std::vector<std::pair<int, int>> taken(before.size());
  Team team(threads);
  for (int k = 0; k < repeats; ++k) {
    std::vector<char> ended(before.size(), 0);
    std::atomic<int> begun{0};
    std::atomic<bool> early{false};
    const auto ready = [&](Index i, const Team::Done& done) {
      return std::ranges::all_of(before[i], [&](int other) { return done[other] != 0; });
    };
    const auto body = [&](Index i, int member) {
      taken[i] = {member, begun.fetch_add(1)};
      // Deliberately not atomic: the team must establish the order of memory between dependent works.
      for (const int other : before[i]) early = early || ended[other] == 0;
      const auto end = Clock::now() + std::chrono::duration<double>(seconds);
      while (Clock::now() < end) rest();
      ended[i] = 1;
    };
    team.run(static_cast<Index>(before.size()), ready, body);
    if (early) throw std::logic_error("a work began before one that it waits for had ended");
    if (std::ranges::count(ended, 1) != std::ssize(before)) {
      throw std::logic_error("run() came back before all had ended");
    }
  }
  return taken;
}

/// Order in which bodies of these costs begin; `failing` ones throw.
std::vector<int> order_of_environments(std::size_t count,
                                       int threads,
                                       const std::vector<double>& costs,
                                       const std::vector<int>& failing) {
  std::vector<int> order(count);
  const std::vector<Turn> turns =
      for_environments(count, threads, costs, [&](Index i, const Checkpoint&) {
        if (std::ranges::find(failing, i) != failing.end()) {
          throw std::invalid_argument("environment " + std::to_string(i));
        }
      });
  for (std::size_t i = 0; i < count; ++i) order[turns[i].place] = static_cast<int>(i);
  return order;
}

}  // namespace

void common_kernels(nb::module_& m) {
  m.def("run_team", &run_team, "before"_a, "threads"_a, "seconds"_a = 0.0, "repeats"_a = 1,
        "Run works on a team; returns the member that did each, and its turn.");
  m.def("order_of_environments", &order_of_environments, "count"_a, "threads"_a, "costs"_a,
        "failing"_a = std::vector<int>{},
        "Run bodies of these expected costs; returns the order in which they begin.");
  m.def("run_environments", &run_environments, "count"_a, "threads"_a, "seconds"_a,
        "failing"_a = std::vector<int>{},
        "Run bodies that wait; returns how many each thread took, the caller's first.");
}

}  // namespace diffcloth::bind
