#pragma once

#include <ctime>

namespace diffcloth {

/// Processor time of the calling thread so far [s]. A call takes up to a microsecond, because it is a
/// system call.
inline double processor_seconds() {
  timespec t{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

}  // namespace diffcloth
