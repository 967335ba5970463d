#pragma once

#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

/// Eigenvector of the smallest eigenvalue of a matrix on the rows, relative to the metric of the
/// objective, with displacement 1 and a fixed sign. Empty if the eigenvalue is not found to be negative.
///
/// @param H  assembled by the system at the current point of the objective
std::vector<double> most_negative(const Objective& f,
                                  LinearSystem& system,
                                  const Checkpoint& checkpoint,
                                  const linalg::BlockMatrix& H);

/// Leave a point with a vanishing gradient and an indefinite Hessian along the direction of most
/// negative curvature relative to the metric, with a fixed sign. False if no lower point is found.
bool leave_saddle(Walk& walk);

}  // namespace diffcloth::solver
