#pragma once

#include <cstddef>
#include <memory>

#include "bodies/smooth_function.h"

namespace diffcloth::bodies {

/// Motion of the free bodies of a scene over one step without contact, and their state after the solve.
/// Equations and names of all arrays: diffcloth_torch/dynamics/bodies.py.
std::unique_ptr<SmoothFunction> body_prediction(std::size_t bodies, double dt);
std::unique_ptr<SmoothFunction> body_advance(std::size_t bodies, double dt);

}  // namespace diffcloth::bodies
