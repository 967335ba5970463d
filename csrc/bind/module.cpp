#include "bind/bind.h"

NB_MODULE(_core, m) {
  namespace nb = nanobind;
  // A script that ends while it holds a graph keeps its simulator to the very end: no leak, and
  // nothing that its user should read about.
  nb::set_leak_warnings(false);
  m.doc() = "C++ core of diffcloth_torch. The public interface is the Python package.";

  diffcloth::bind::build_info(m);
  diffcloth::bind::free_motion(m);
  diffcloth::bind::simulator(m);
}
