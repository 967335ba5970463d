#include "bind/environments.h"

#include "bind/bind.h"
#include "common/parallel_for.h"

namespace diffcloth::bind {

void for_environments(std::size_t count,
                      int threads,
                      const std::function<void(Index, const Checkpoint&)>& body) {
  Interrupt interrupt([] {
    const nb::gil_scoped_acquire gil;
    return PyErr_CheckSignals() != 0;
  });
  try {
    const nb::gil_scoped_release nogil;
    parallel_for(static_cast<Index>(count), threads, interrupt, body);
  } catch (const Interrupted&) {
    throw nb::python_error();  // the error that the signal handler has set
  }
}

}  // namespace diffcloth::bind
