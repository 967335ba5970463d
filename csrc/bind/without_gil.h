#pragma once

#include <vector>

#include <Python.h>

namespace diffcloth::bind {

/// Scope without the GIL, like nb::gil_scoped_release, that is safe during interpreter shutdown.
///
/// After finalization, Python terminates a thread that requests the GIL by unwinding its stack;
/// destructors on that stack must not throw, so the process would abort. A daemon thread is therefore
/// parked until process exit instead of reacquiring the GIL.
class WithoutGil {
 public:
  WithoutGil() : state_(PyEval_SaveThread()) {}
  ~WithoutGil();
  WithoutGil(const WithoutGil&) = delete;
  WithoutGil& operator=(const WithoutGil&) = delete;

 private:
  PyThreadState* state_;
};

/// Stop all calls from returning to Python, except in the calling thread.
void abandon_calls();

/// True if this thread must not reacquire the GIL; no caller waits for its result.
bool is_abandoned();

/// Python identifiers of the parked threads.
std::vector<unsigned long> parked_threads();

}  // namespace diffcloth::bind
