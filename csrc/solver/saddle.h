#pragma once

#include "solver/walk.h"

namespace diffcloth::solver {

/// Leave a point where the gradient vanishes but the Hessian is indefinite, along its most negative
/// direction relative to the metric, with a fixed sign. False when no lower point is found.
bool leave_saddle(Walk& walk);

}  // namespace diffcloth::solver
