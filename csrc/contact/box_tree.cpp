#include "contact/box_tree.h"

#include <algorithm>
#include <numeric>
#include <utility>

#include <Eigen/Geometry>

namespace diffcloth::contact {
namespace {

constexpr Index kLeafSize = kBoxGroup;

/// Smallest box around a group; NaN is ignored.
Box around(const BoxGroup& group) {
  Box box = kEmptyBox;
  for (int axis = 0; axis < 3; ++axis) {
    for (int k = 0; k < kBoxGroup; ++k) {
      box.lo[axis] = std::min(box.lo[axis], group.lo[axis][k]);
      box.hi[axis] = std::max(box.hi[axis], group.hi[axis][k]);
    }
  }
  return box;
}

}  // namespace

BoxTree::BoxTree(std::vector<Index> ids, std::span<const Vec3> centers) {
  if (ids.empty()) return;
  const auto count = static_cast<Index>(ids.size());
  std::vector<Index> order(count);
  std::iota(order.begin(), order.end(), 0);

  nodes_.push_back({.first = 0, .last = count, .left = 0});
  for (std::size_t k = 0; k < nodes_.size(); ++k) {
    const auto [first, last, left] = nodes_[k];
    if (last - first <= kLeafSize) continue;
    Eigen::AlignedBox3d extent;
    for (Index i = first; i < last; ++i) extent.extend(centers[order[i]]);
    int axis = 0;
    extent.sizes().maxCoeff(&axis);

    // Half of the leaves on either side of the split, so that leaves are full.
    const Index leaf_count = (last - first + kLeafSize - 1) / kLeafSize;
    const Index middle = first + (leaf_count + 1) / 2 * kLeafSize;
    std::nth_element(order.begin() + first, order.begin() + middle, order.begin() + last,
                     [&](Index i, Index j) {
                       const double x_i = centers[i][axis];
                       const double x_j = centers[j][axis];
                       return x_i < x_j || (x_i == x_j && i < j);
                     });
    nodes_[k].left = static_cast<Index>(nodes_.size());
    nodes_.push_back({.first = first, .last = middle, .left = 0});
    nodes_.push_back({.first = middle, .last = last, .left = 0});
  }
  items_.reserve(count);
  for (const Index i : order) items_.push_back(ids[i]);
}

void BoxTree::refit(Boxes& boxes) const {
  boxes.nodes.resize(nodes_.size());
  for (std::size_t k = nodes_.size(); k-- > 0;) {
    const Node& node = nodes_[k];
    boxes.nodes[k] = node.left > 0 ? united(boxes.nodes[node.left], boxes.nodes[node.left + 1])
                                   : around(boxes.items[node.first / kLeafSize]);
  }
}

}  // namespace diffcloth::contact
