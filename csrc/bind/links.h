#pragma once

#include <vector>

#include "bodies/mechanisms.h"

namespace diffcloth::bind {

/// Arrays that define links, one entry a link; matrices are row-major.
struct LinkArrays {
  std::vector<Index> tree;
  std::vector<Index> parent;
  std::vector<Index> kind;        ///< index in joint_kinds()
  std::vector<double> offset;     ///< [L, 4, 4]
  std::vector<double> axis;       ///< [L, 3]
  std::vector<Index> coordinate;  ///< -1 for a fixed joint
  std::vector<double> multiplier;
  std::vector<double> constant;
};

/// Build links with `coordinates` coordinates. The order of links and their parents are not checked
/// here.
///
/// @throws std::invalid_argument  if lengths do not match, or kinds and coordinates are out of range
std::vector<bodies::Link> to_links(const LinkArrays& arrays, Index coordinates);

}  // namespace diffcloth::bind
