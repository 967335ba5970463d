#pragma once

#include <vector>

#include "common/types.h"

namespace diffcloth::linalg {

/// How points that have no rows of their own move with rows of a matrix:  dx_p = sum of J dz_row.
///
/// Points are numbered from `first` on, and those before are rows themselves. The rows of a point are
/// a constant; the Jacobians belong to one configuration.
struct Attachments {
  struct Entry {
    Index row;
    Mat3 jacobian;
  };

  Index first = 0;
  std::vector<Index> start{0};  ///< of the entries of point first + k; [points + 1]
  std::vector<Entry> entries;

  bool empty() const { return entries.empty(); }
  const Entry* begin(Index point) const { return entries.data() + start[point - first]; }
  const Entry* end(Index point) const { return entries.data() + start[point - first + 1]; }
};

}  // namespace diffcloth::linalg
