#include <nanobind/stl/vector.h>

#include "bind/bind.h"
#include "bind/without_gil.h"
#include "linalg/kernel_level.h"

NB_MODULE(_core, m) {
  namespace nb = nanobind;
  // A script that exits while it holds a graph keeps its simulator alive until the end: not a leak, so
  // suppress the warning.
  nb::set_leak_warnings(false);
  m.doc() = "C++ core of diffcloth_torch. The public interface is the Python package.";
  diffcloth::linalg::chosen_level();  // import fails if the variable names no level

  diffcloth::bind::build_info(m);
  diffcloth::bind::dynamics(m);
  diffcloth::bind::simulator(m);
  m.def("abandon_calls", &diffcloth::bind::abandon_calls,
        "From now on no call comes back to Python, but in this thread.");
  m.def("parked_threads", &diffcloth::bind::parked_threads,
        "Identifiers of the threads whose calls do not come back.");
}
