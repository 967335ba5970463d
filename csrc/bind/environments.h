#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <vector>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth::bind {

/// How a call took one of its environments.
struct Turn {
  int place = 0;         ///< how many began before it
  double seconds = 0.0;  ///< that it took
};

/// Runs body for every environment on up to `threads` threads, without the GIL; the most expensive
/// begin. Ctrl-C ends all of them and raises.
///
/// @param costs  what each is expected to take, in any unit; may be empty. No result depends on it.
std::vector<Turn> for_environments(std::size_t count,
                                   int threads,
                                   std::span<const double> costs,
                                   const std::function<void(Index, const Checkpoint&)>& body);

/// Threads that each of so many environments has for itself, where there are fewer environments than
/// threads.
int threads_each(std::size_t count, int threads);

}  // namespace diffcloth::bind
