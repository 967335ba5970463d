#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <vector>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth::bind {

/// Order and time of one environment in a call.
struct Turn {
  int place = 0;         ///< number of environments that began before it
  double seconds = 0.0;  ///< wall-clock time [s]
};

/// Run `body` for every environment on up to `threads` threads, without the GIL, the most expensive
/// environments first. Ctrl-C stops all of them and raises.
///
/// @param costs  expected cost of each, in any unit; may be empty. Results do not depend on it.
std::vector<Turn> for_environments(std::size_t count,
                                   int threads,
                                   std::span<const double> costs,
                                   const std::function<void(Index, const Checkpoint&)>& body);

/// Number of threads for each of `count` environments; more than one if there are fewer environments
/// than threads.
int threads_each(std::size_t count, int threads);

}  // namespace diffcloth::bind
