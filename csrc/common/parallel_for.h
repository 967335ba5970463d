#pragma once

#include <functional>
#include <span>
#include <vector>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth {

/// Indices in descending order of cost, ascending for equal costs; all indices in ascending order if
/// `costs` does not have `count` entries.
std::vector<Index> most_expensive_first(Index count, std::span<const double> costs);

/// Run body(i, checkpoint) for i in [0, count) on up to `threads` threads, including the caller's. Each
/// thread takes the most expensive remaining index, because all others would wait for a long one that
/// begins last.
///
/// @param costs  expected cost of each index, in any unit; may be empty. Results do not depend on it.
///
/// Each index is one environment and owns its outputs, so the result does not depend on the number of
/// threads. Threads live only during the call; if the system provides fewer, fewer do the work. The
/// exception of the lowest index is rethrown after all have stopped; an interrupt stops all of them.
void parallel_for(Index count,
                  int threads,
                  std::span<const double> costs,
                  Interrupt& interrupt,
                  const std::function<void(Index, const Checkpoint&)>& body);

}  // namespace diffcloth
