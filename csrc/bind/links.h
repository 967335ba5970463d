#pragma once

#include <vector>

#include "bodies/mechanisms.h"

namespace diffcloth::bind {

/// What links are made from, one entry a link; matrices row after row.
struct LinkArrays {
  std::vector<Index> tree;
  std::vector<Index> parent;
  std::vector<Index> kind;        ///< a place in joint_kinds()
  std::vector<double> offset;     ///< [L, 4, 4]
  std::vector<double> axis;       ///< [L, 3]
  std::vector<Index> coordinate;  ///< -1 where a joint is fixed
  std::vector<double> multiplier;
  std::vector<double> constant;
};

/// Links of `coordinates` coordinates. Their order and their parents are still to be checked.
///
/// @throws std::invalid_argument where lengths do not agree, or kinds and coordinates are out of range
std::vector<bodies::Link> to_links(const LinkArrays& arrays, Index coordinates);

}  // namespace diffcloth::bind
