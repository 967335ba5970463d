#pragma once

#include <nanobind/nanobind.h>

namespace diffcloth::bind {

namespace nb = nanobind;

/// `build_info()`: configuration of this build.
void build_info(nb::module_& m);

/// Functions of bodies and robots over a step, before and after the solve.
void dynamics(nb::module_& m);

/// The simulator's handle: forward and backward of a step.
void simulator(nb::module_& m);

}  // namespace diffcloth::bind
