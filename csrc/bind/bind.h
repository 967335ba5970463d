#pragma once

#include <nanobind/nanobind.h>

namespace diffcloth::bind {

namespace nb = nanobind;

/// `build_info()`: what this core was built with.
void build_info(nb::module_& m);

/// Bodies and robots over a step, but for what the solver does.
void dynamics(nb::module_& m);

/// The simulator's handle: forward and backward of a step.
void simulator(nb::module_& m);

}  // namespace diffcloth::bind
