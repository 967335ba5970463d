#pragma once

#include <vector>

#include "common/types.h"

namespace diffcloth::linalg {

/// Motion of points without rows of their own, as a function of rows of a matrix:  dx_p = sum of J
/// dz_row.
///
/// Points from number `first` on are attached; points before `first` are rows themselves. The rows of a
/// point are constant; the Jacobians belong to one configuration.
struct Attachments {
  struct Entry {
    Index row;
    Mat3 jacobian;
  };

  Index first = 0;
  std::vector<Index> start{0};  ///< [points + 1] first entry of point first + k
  std::vector<Entry> entries;

  bool empty() const { return entries.empty(); }
  const Entry* begin(Index point) const { return entries.data() + start[point - first]; }
  const Entry* end(Index point) const { return entries.data() + start[point - first + 1]; }
};

}  // namespace diffcloth::linalg
