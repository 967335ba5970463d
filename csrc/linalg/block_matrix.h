#pragma once

#include <utility>
#include <vector>

#include "linalg/block_pattern.h"

namespace diffcloth::linalg {

/// A pattern enlarged by further couplings, and where the slots of the smaller one went.
struct MergedPattern {
  BlockPattern pattern;
  std::vector<Index> slot_of_base;  ///< [base.block_count()]
};

/// Enlarge a pattern by lower-triangle pairs (row, column), row >= column, in any order.
MergedPattern merge(const BlockPattern& base, std::vector<std::pair<Index, Index>> pairs);

/// y += A x for a symmetric matrix given by its lower blocks on the pattern.
void add_product(const BlockPattern& pattern, const double* blocks, const double* x, double* y);

}  // namespace diffcloth::linalg
