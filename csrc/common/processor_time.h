#pragma once

#include <ctime>

namespace diffcloth {

/// Processor time that the calling thread has taken so far [s]. A call takes up to a microsecond: it asks the
/// system.
inline double processor_seconds() {
  timespec t{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

}  // namespace diffcloth
