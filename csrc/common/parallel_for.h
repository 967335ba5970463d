#pragma once

#include <functional>
#include <span>
#include <vector>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth {

/// Indices by falling cost, those of equal cost in ascending order. All of them, in ascending order,
/// where costs are not as many.
std::vector<Index> most_expensive_first(Index count, std::span<const double> costs);

/// Run body(i, checkpoint) for i in [0, count) on up to `threads` threads, the caller's included.
/// Each thread takes the most expensive of those that are left: what is long and begins last would
/// have all others wait.
///
/// @param costs  what each is expected to take, in any unit; may be empty. No result depends on it.
///
/// Each index is one environment and owns its outputs, so the result does not depend on the number
/// of threads. Threads live only inside the call; where the system refuses to make as many, fewer do
/// the work. The first exception (of the lowest index) is
/// rethrown once all have stopped; an interrupt stops all of them.
void parallel_for(Index count,
                  int threads,
                  std::span<const double> costs,
                  Interrupt& interrupt,
                  const std::function<void(Index, const Checkpoint&)>& body);

}  // namespace diffcloth
