#pragma once

#include <cstddef>
#include <memory>

#include "bodies/smooth_function.h"

namespace diffcloth::bodies {

/// Free bodies of a scene over one step by themselves, and their state after the step is solved: for
/// their equations see diffcloth_torch/dynamics/bodies.py, which names all arrays.
std::unique_ptr<SmoothFunction> body_prediction(std::size_t bodies, double dt);
std::unique_ptr<SmoothFunction> body_advance(std::size_t bodies, double dt);

}  // namespace diffcloth::bodies
