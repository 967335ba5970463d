#pragma once

#include <functional>

#include "common/interrupt.h"
#include "common/types.h"

namespace diffcloth {

/// Run body(i, checkpoint) for i in [0, count) on up to `threads` threads, the caller's included.
///
/// Each index is one environment and owns its outputs, so the result does not depend on the number
/// of threads. Threads live only inside the call; where the system refuses to make as many, fewer do
/// the work. The first exception (of the lowest index) is
/// rethrown once all have stopped; an interrupt stops all of them.
void parallel_for(Index count,
                  int threads,
                  Interrupt& interrupt,
                  const std::function<void(Index, const Checkpoint&)>& body);

}  // namespace diffcloth
