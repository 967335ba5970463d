#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "contact/direction_kernels.h"

namespace diffcloth::contact {

/// Vectors over all points, side by side; unused lanes are zero.
class DirectionRows {
 public:
  DirectionRows(const DirectionKernels& kernels, std::size_t size)
      : lanes_(static_cast<std::size_t>(kernels.lanes)), rows_(lanes_ * size) {}

  void read(std::span<const double* const> vectors);
  void read(std::span<double* const> vectors);
  void write(std::span<double* const> vectors) const;

  double* data() { return rows_.data(); }

 private:
  std::size_t lanes_;
  std::vector<double> rows_;
};

/// Call f(kernels, first, count) for directions first .. first + count - 1, as many at once as there are lanes.
template <class Call>
void for_direction_groups(std::size_t directions, Call call) {
  const DirectionLevel& best = direction_kernels(linalg::chosen_level());
  for (std::size_t first = 0; first < directions;) {
    const std::size_t left = directions - first;
    const std::size_t count = left < kDirectionLanes ? left : kDirectionLanes;
    call(count > 1 ? best.many : best.one, first, count);
    first += count;
  }
}

}  // namespace diffcloth::contact
