#pragma once

#include <cstddef>
#include <functional>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth::bind {

/// Runs body for every environment on up to `threads` threads, without the GIL. Ctrl-C ends all of
/// them and raises.
void for_environments(std::size_t count,
                      int threads,
                      const std::function<void(Index, const Checkpoint&)>& body);

/// Threads that each of so many environments has for itself, where there are fewer environments than
/// threads.
int threads_each(std::size_t count, int threads);

}  // namespace diffcloth::bind
