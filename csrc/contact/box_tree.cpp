#include "contact/box_tree.h"

#include <algorithm>
#include <numeric>

namespace diffcloth::contact {

BoxTree::BoxTree(const std::vector<Vec3>& centers) {
  if (centers.empty()) return;
  std::vector<Index> order(centers.size());
  std::iota(order.begin(), order.end(), 0);
  struct Range {
    Index node, first, last;
  };
  std::vector<Range> pending{{0, 0, static_cast<Index>(order.size())}};
  nodes_.emplace_back();
  while (!pending.empty()) {
    const Range range = pending.back();
    pending.pop_back();
    const Index count = range.last - range.first;
    nodes_[range.node].size = count;
    if (count == 1) {
      nodes_[range.node].primitive = order[range.first];
      continue;
    }
    Vec3 lower = centers[order[range.first]];
    Vec3 upper = lower;
    for (Index k = range.first; k < range.last; ++k) {
      lower = lower.cwiseMin(centers[order[k]]);
      upper = upper.cwiseMax(centers[order[k]]);
    }
    Index axis = 0;
    (upper - lower).maxCoeff(&axis);
    const Index middle = range.first + count / 2;
    std::nth_element(order.begin() + range.first,
                     order.begin() + middle,
                     order.begin() + range.last,
                     [&](Index p, Index q) {
                       return centers[p][axis] != centers[q][axis]
                                  ? centers[p][axis] < centers[q][axis]
                                  : p < q;
                     });
    const auto left = static_cast<Index>(nodes_.size());
    nodes_[range.node].left = left;
    nodes_.emplace_back();
    nodes_.emplace_back();
    pending.push_back({left, range.first, middle});
    pending.push_back({left + 1, middle, range.last});
  }
}

void BoxTree::refit(const std::vector<Box>& primitives, std::vector<Box>& nodes) const {
  nodes.resize(nodes_.size());
  for (std::size_t k = nodes_.size(); k-- > 0;) {
    const Node& node = nodes_[k];
    if (node.left < 0) {
      nodes[k] = primitives[node.primitive];
    } else {
      nodes[k] = nodes[node.left];
      nodes[k].include(nodes[node.left + 1]);
    }
  }
}

}  // namespace diffcloth::contact
