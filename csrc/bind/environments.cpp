#include "bind/environments.h"

#include <algorithm>

#include "bind/bind.h"
#include "bind/without_gil.h"
#include "common/parallel_for.h"

namespace diffcloth::bind {

void for_environments(std::size_t count,
                      int threads,
                      const std::function<void(Index, const Checkpoint&)>& body) {
  Interrupt interrupt([] {
    if (is_abandoned()) return true;
    const nb::gil_scoped_acquire gil;
    return PyErr_CheckSignals() != 0;
  });
  try {
    const WithoutGil nogil;
    parallel_for(static_cast<Index>(count), threads, interrupt, body);
  } catch (const Interrupted&) {
    throw nb::python_error();  // the error that the signal handler has set
  }
}

int threads_each(std::size_t count, int threads) {
  // The tasks of a factorization of 96 x 96 vertices take a third of the time on four threads: the way
  // to the root of the elimination tree leaves little to do for more.
  constexpr int kMost = 4;
  return std::clamp(threads / std::max(static_cast<int>(count), 1), 1, kMost);
}

}  // namespace diffcloth::bind
