#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include "common/types.h"
#include "contact/box_group.h"

namespace diffcloth::contact {

/// Axis-aligned box.
struct Box {
  std::array<double, 3> lo;
  std::array<double, 3> hi;
};

inline constexpr Box kEmptyBox{
    .lo = {std::numeric_limits<double>::infinity(), std::numeric_limits<double>::infinity(),
           std::numeric_limits<double>::infinity()},
    .hi = {-std::numeric_limits<double>::infinity(), -std::numeric_limits<double>::infinity(),
           -std::numeric_limits<double>::infinity()}};

/// True if two closed boxes have a point in common. All six comparisons are evaluated without branches,
/// because the outcome of each is unpredictable.
inline bool overlap(const Box& a, const Box& b) {
  return (a.lo[0] <= b.hi[0]) & (b.lo[0] <= a.hi[0]) & (a.lo[1] <= b.hi[1]) & (b.lo[1] <= a.hi[1]) &
         (a.lo[2] <= b.hi[2]) & (b.lo[2] <= a.hi[2]);
}

/// Smallest box around two boxes.
inline Box united(const Box& a, const Box& b) {
  Box box;
  for (int k = 0; k < 3; ++k) {
    box.lo[k] = a.lo[k] < b.lo[k] ? a.lo[k] : b.lo[k];
    box.hi[k] = a.hi[k] > b.hi[k] ? a.hi[k] : b.hi[k];
  }
  return box;
}

/// Binary tree over boxes whose shape is fixed at construction; afterwards only the boxes are refitted.
/// The nodes that a search visits, and their order, therefore do not depend on earlier searches.
class BoxTree {
 public:
  /// A node holds the items first .. last - 1 of items(). A leaf has no children (left = 0), and its
  /// items are one group. The children of an inner node are the nodes left and left + 1, which follow
  /// the node in nodes().
  struct Node {
    Index first;
    Index last;
    Index left;
  };

  /// Boxes of a tree at one moment, in the order of items() and of nodes().
  struct Boxes {
    std::vector<BoxGroup> items;
    std::vector<Box> nodes;
  };

  BoxTree() = default;

  /// Tree over items with the given centers (centers[i] belongs to ids[i]), split at the median of
  /// the longest axis.
  BoxTree(std::vector<Index> ids, std::span<const Vec3> centers);

  bool empty() const { return items_.empty(); }
  const std::vector<Index>& items() const { return items_; }
  const std::vector<Node>& nodes() const { return nodes_; }
  std::span<const Index> items_of(const Node& node) const {
    return std::span(items_).subspan(node.first, node.last - node.first);
  }

  /// Compute the boxes of all items by `box_of`, and the boxes of all nodes from them.
  template <class BoxOf>
  void fit(Boxes& boxes, BoxOf&& box_of) const {
    boxes.items.resize((items_.size() + kBoxGroup - 1) / kBoxGroup);
    for (std::size_t k = 0; k < kBoxGroup * boxes.items.size(); ++k) {
      const Box box = k < items_.size() ? box_of(items_[k]) : kEmptyBox;
      BoxGroup& group = boxes.items[k / kBoxGroup];
      for (int axis = 0; axis < 3; ++axis) {
        group.lo[axis][k % kBoxGroup] = box.lo[axis];
        group.hi[axis][k % kBoxGroup] = box.hi[axis];
      }
    }
    refit(boxes);
  }

 private:
  void refit(Boxes& boxes) const;

  std::vector<Index> items_;
  std::vector<Node> nodes_;
};

/// Visit the candidate pairs of leaves of two trees, or of one tree with itself (each pair once). The
/// outcome of `near` is unpredictable: every pair is written to the stack, and the stack grows by the
/// outcome, which avoids branch mispredictions.
///
/// @param near  predicate on two node numbers: false only if no pair of items in the nodes is wanted
template <class Stack, class Near, class Visit>
void visit_leaf_pairs(
    const BoxTree& tree_a, const BoxTree& tree_b, Stack& stack, Near&& near, Visit&& visit) {
  if (tree_a.empty() || tree_b.empty() || !near(0, 0)) return;
  const bool own = &tree_a == &tree_b;
  const auto push = [&](Index i, Index j) {
    auto* const end = stack.room(1);
    *end = {i, j};
    stack.end_at(end + near(i, j));
  };
  stack.clear();
  stack.push({0, 0});
  while (stack.size() > 0) {
    const auto [i, j] = stack.pop();
    const BoxTree::Node& p = tree_a.nodes()[i];
    const BoxTree::Node& q = tree_b.nodes()[j];
    if (p.left == 0 && q.left == 0) {
      visit(p, q);
    } else if (own && i == j) {
      push(p.left, p.left);
      push(p.left + 1, p.left + 1);
      push(p.left, p.left + 1);
    } else if (q.left == 0 || (p.left != 0 && p.last - p.first >= q.last - q.first)) {
      push(p.left, j);
      push(p.left + 1, j);
    } else {
      push(i, q.left);
      push(i, q.left + 1);
    }
  }
}

}  // namespace diffcloth::contact
