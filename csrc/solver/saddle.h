#pragma once

#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

/// Direction of the smallest eigenvalue of a matrix on the rows relative to the metric of the objective:
/// its displacement is 1 and its sign fixed. Empty where it is not seen to be negative.
///
/// @param H  made by the system at the point where the objective stands
std::vector<double> most_negative(const Objective& f,
                                  LinearSystem& system,
                                  const Checkpoint& checkpoint,
                                  const linalg::BlockMatrix& H);

/// Leave a point where the gradient vanishes but the Hessian is indefinite, along its most negative
/// direction relative to the metric, with a fixed sign. False when no lower point is found.
bool leave_saddle(Walk& walk);

}  // namespace diffcloth::solver
