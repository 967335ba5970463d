#pragma once

#include <vector>

#include <Python.h>

namespace diffcloth::bind {

/// Work without the GIL, as nb::gil_scoped_release has it, that survives the end of the interpreter.
///
/// Python ends a thread that wants the GIL once the interpreter ends, by unwinding its stack: where that
/// has destructors, which may not throw, the whole process is aborted. A daemon thread is therefore
/// parked instead of given the GIL back: until the process ends, which needs no other thread.
class WithoutGil {
 public:
  WithoutGil() : state_(PyEval_SaveThread()) {}
  ~WithoutGil();
  WithoutGil(const WithoutGil&) = delete;
  WithoutGil& operator=(const WithoutGil&) = delete;

 private:
  PyThreadState* state_;
};

/// From now on no call comes back to Python, but in the thread that calls this.
void abandon_calls();

/// Whether that is so for this thread: nobody waits for its result, and the GIL must not be asked for.
bool is_abandoned();

/// Identifiers of the threads that are parked, by which Python knows them.
std::vector<unsigned long> parked_threads();

}  // namespace diffcloth::bind
