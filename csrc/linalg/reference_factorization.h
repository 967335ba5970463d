#pragma once

#include "linalg/block_matrix.h"

namespace diffcloth::linalg {

/// Seconds of one numeric factorization by Eigen's SimplicialLDLT, minimum degree order, no BLAS: the median of
/// several.
double reference_factorization_seconds(const BlockMatrix& A, int repeats);

}  // namespace diffcloth::linalg
