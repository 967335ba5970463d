#pragma once

#include <utility>
#include <vector>

#include "common/types.h"

namespace diffcloth::contact {

/// Axis-aligned box.
struct Box {
  Vec3 lower;
  Vec3 upper;

  bool overlaps(const Box& other) const {
    return (lower.array() <= other.upper.array()).all() &&
           (other.lower.array() <= upper.array()).all();
  }
  void include(const Box& other) {
    lower = lower.cwiseMin(other.lower);
    upper = upper.cwiseMax(other.upper);
  }
};

/// Binary tree over primitives with a fixed topology: only the boxes change, so results depend on
/// the boxes alone and not on what the tree saw before.
class BoxTree {
 public:
  BoxTree() = default;

  /// Split by the median of the centers along the longest extent.
  explicit BoxTree(const std::vector<Vec3>& centers);

  bool empty() const { return nodes_.empty(); }

  /// Boxes of all nodes, children after parents, from those of the primitives.
  void refit(const std::vector<Box>& primitives, std::vector<Box>& nodes) const;

  /// visit(a, b) for all pairs of primitives of two trees whose boxes overlap.
  template <class Visit>
  static void overlaps(const BoxTree& a,
                       const std::vector<Box>& boxes_a,
                       const BoxTree& b,
                       const std::vector<Box>& boxes_b,
                       std::vector<std::pair<Index, Index>>& stack,
                       const Visit& visit);

  /// visit(p, q), p < q, for all pairs of primitives of one tree whose boxes overlap.
  template <class Visit>
  void self_overlaps(const std::vector<Box>& boxes,
                     std::vector<std::pair<Index, Index>>& stack,
                     const Visit& visit) const;

 private:
  /// Children are neighbors in the array: left, left + 1. A leaf has left = -1 and a primitive.
  struct Node {
    Index left = -1;
    Index primitive = -1;
    Index size = 1;  ///< primitives below
  };
  std::vector<Node> nodes_;
};

template <class Visit>
void BoxTree::overlaps(const BoxTree& a,
                       const std::vector<Box>& boxes_a,
                       const BoxTree& b,
                       const std::vector<Box>& boxes_b,
                       std::vector<std::pair<Index, Index>>& stack,
                       const Visit& visit) {
  if (a.empty() || b.empty()) return;
  stack.clear();
  stack.emplace_back(0, 0);
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    if (!boxes_a[i].overlaps(boxes_b[j])) continue;
    const Node& p = a.nodes_[i];
    const Node& q = b.nodes_[j];
    if (p.left < 0 && q.left < 0) {
      visit(p.primitive, q.primitive);
    } else if (q.left < 0 || (p.left >= 0 && p.size >= q.size)) {
      stack.emplace_back(p.left, j);
      stack.emplace_back(p.left + 1, j);
    } else {
      stack.emplace_back(i, q.left);
      stack.emplace_back(i, q.left + 1);
    }
  }
}

template <class Visit>
void BoxTree::self_overlaps(const std::vector<Box>& boxes,
                            std::vector<std::pair<Index, Index>>& stack,
                            const Visit& visit) const {
  if (empty()) return;
  stack.clear();
  stack.emplace_back(0, 0);
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    const Node& p = nodes_[i];
    const Node& q = nodes_[j];
    if (i == j) {
      if (p.left < 0) continue;
      stack.emplace_back(p.left, p.left);
      stack.emplace_back(p.left + 1, p.left + 1);
      stack.emplace_back(p.left, p.left + 1);
      continue;
    }
    if (!boxes[i].overlaps(boxes[j])) continue;
    if (p.left < 0 && q.left < 0) {
      visit(std::min(p.primitive, q.primitive), std::max(p.primitive, q.primitive));
    } else if (q.left < 0 || (p.left >= 0 && p.size >= q.size)) {
      stack.emplace_back(p.left, j);
      stack.emplace_back(p.left + 1, j);
    } else {
      stack.emplace_back(i, q.left);
      stack.emplace_back(i, q.left + 1);
    }
  }
}

}  // namespace diffcloth::contact
