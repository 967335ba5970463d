#pragma once

#include <algorithm>
#include <cstddef>
#include <numeric>
#include <vector>

#include "common/types.h"

namespace diffcloth {

/// Disjoint sets of 0 .. size - 1, each represented by its lowest member.
class DisjointSets {
 public:
  explicit DisjointSets(std::size_t size) : parent_(size) {
    std::iota(parent_.begin(), parent_.end(), 0);
  }
  Index find(Index i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }
  void unite(Index i, Index j) {
    const Index p = find(i);
    const Index q = find(j);
    parent_[std::max(p, q)] = std::min(p, q);
  }

 private:
  std::vector<Index> parent_;
};

}  // namespace diffcloth
