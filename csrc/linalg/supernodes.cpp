#include "linalg/supernodes.h"

#include <algorithm>

namespace diffcloth::linalg {
namespace {

/// A supernode during merging.
struct Node {
  Index columns;  ///< vertices
  Index rows;     ///< vertices below
  double zeros;   ///< structurally zero blocks of its panel
  Index parent;
  Index merged_into;  ///< -1, or the parent that now contains its columns
};

double panel_blocks(Index columns, Index rows) {
  return 0.5 * columns * (columns + 1.0) + static_cast<double>(columns) * rows;
}

/// True if a panel with this many columns may have this fraction of zeros.
bool few_zeros(Index columns, double share) {
  const Index scalars = 3 * columns;
  return (scalars <= 16 && share < 0.8) || (scalars <= 48 && share < 0.1) || share < 0.05;
}

/// Operations to eliminate a front of this size, in vertices.
double operations(Index columns, Index rows) {
  const auto c = static_cast<double>(columns);
  const auto r = static_cast<double>(rows);
  return 27.0 * c * (c * c / 3.0 + c * r + r * r);
}

/// Costs in operations: start of the kernels of a front, and addition of one entry to a parent.
constexpr double kFront = 2e4;
constexpr double kMoved = 20.0;

/// True if a child costs less as a part of its parent than as a separate front.
bool is_cheaper_together(const Node& child, const Node& parent) {
  const double apart =
      operations(child.columns, child.rows) + operations(parent.columns, parent.rows);
  const double together = operations(child.columns + parent.columns, parent.rows);
  const double moved = 4.5 * static_cast<double>(child.rows) * (child.rows + 1.0);
  return together - apart < kFront + kMoved * moved;
}

/// Supernodes of columns with the same structure below; owner[k] is the supernode of column k.
std::vector<Node> fundamental(const EliminationTree& tree, std::vector<Index>& owner) {
  const auto n = static_cast<Index>(tree.order.size());
  std::vector<Node> nodes;
  owner.resize(n);
  for (Index k = 0; k < n; ++k) {
    const bool continues =
        k > 0 && tree.parent[k - 1] == k && tree.height[k - 1] == tree.height[k] + 1;
    if (!continues) {
      nodes.push_back({.columns = 0, .rows = 0, .zeros = 0.0, .parent = -1, .merged_into = -1});
    }
    ++nodes.back().columns;
    nodes.back().rows = tree.height[k] - 1;
    owner[k] = static_cast<Index>(nodes.size()) - 1;
  }
  for (Index k = 0; k < n; ++k) {
    const Index p = tree.parent[k] == -1 ? -1 : owner[tree.parent[k]];
    if (p != owner[k]) nodes[owner[k]].parent = p;
  }
  return nodes;
}

/// Zeros of the panel of a child merged with its parent.
double zeros_together(const Node& child, const Node& parent) {
  return child.zeros + parent.zeros +
         static_cast<double>(child.columns) * (parent.columns + parent.rows - child.rows);
}

/// Merge children into their parents, from the leaves up, children that add the fewest zeros first.
void merge_children(std::vector<Node>& nodes) {
  const auto count = static_cast<Index>(nodes.size());
  std::vector<std::vector<Index>> children(count);
  for (Index s = 0; s < count; ++s) {
    Node& node = nodes[s];
    std::vector<Index>& candidates = children[s];
    while (!candidates.empty()) {
      const auto best = std::ranges::min_element(
          candidates, {}, [&](Index c) { return zeros_together(nodes[c], node); });
      const Node& child = nodes[*best];
      const Index columns = child.columns + node.columns;
      const double zeros = zeros_together(child, node);
      if (!few_zeros(columns, zeros / panel_blocks(columns, node.rows)) &&
          !is_cheaper_together(child, node))
        break;
      nodes[*best].merged_into = s;
      node.columns = columns;
      node.zeros = zeros;
      candidates.erase(best);
    }
    if (node.parent != -1) children[node.parent].push_back(s);
  }
}

}  // namespace

SupernodeTree gather_supernodes(const EliminationTree& tree) {
  std::vector<Index> owner;
  std::vector<Node> nodes = fundamental(tree, owner);
  merge_children(nodes);

  // Parents follow their children: roots of merged groups are found backwards.
  const auto count = static_cast<Index>(nodes.size());
  std::vector<Index> group(count);
  for (Index s = count - 1; s >= 0; --s) {
    group[s] = nodes[s].merged_into == -1 ? s : group[nodes[s].merged_into];
  }
  // Groups in the order of their last members are still in postorder.
  SupernodeTree result;
  std::vector<Index> place(count, -1);
  result.start.push_back(0);
  for (Index s = 0; s < count; ++s) {
    if (group[s] != s) continue;
    place[s] = result.size();
    result.parent.push_back(-1);
    result.start.push_back(result.start.back() + nodes[s].columns);
  }
  for (Index s = 0; s < count; ++s) {
    if (group[s] == s && nodes[s].parent != -1) {
      result.parent[place[s]] = place[group[nodes[s].parent]];
    }
  }
  std::vector<Index> next = result.start;
  result.column.resize(owner.size());
  for (std::size_t k = 0; k < owner.size(); ++k) {
    result.column[next[place[group[owner[k]]]]++] = static_cast<Index>(k);
  }
  return result;
}

}  // namespace diffcloth::linalg
