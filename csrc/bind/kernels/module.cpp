#include "bind/kernels/kernels.h"

// A separate module, so that the shipped one contains no code for tests.
NB_MODULE(_kernels, m) {
  diffcloth::bind::nb::set_leak_warnings(false);  // see bind/module.cpp
  m.doc() = "Single kernels of the C++ core, exposed for tests and benchmarks.";

  diffcloth::bind::air_kernels(m);
  diffcloth::bind::body_kernels(m);
  diffcloth::bind::direction_kernels(m);
  diffcloth::bind::common_kernels(m);
  diffcloth::bind::contact_kernels(m);
  diffcloth::bind::contact_potentials(m);
  diffcloth::bind::elastic_kernels(m);
  diffcloth::bind::linalg_kernels(m);
  diffcloth::bind::projective_kernels(m);
}
