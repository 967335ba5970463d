#include "linalg/elimination_tree.h"

#include <utility>

namespace diffcloth::linalg {
namespace {

std::vector<Index> inverse(const std::vector<Index>& order) {
  std::vector<Index> rank(order.size());
  for (std::size_t k = 0; k < order.size(); ++k) rank[order[k]] = static_cast<Index>(k);
  return rank;
}

/// Parents by Liu's algorithm, with path compression.
std::vector<Index> parents(const Graph& graph,
                           const std::vector<Index>& order,
                           const std::vector<Index>& rank) {
  const Index n = graph.size();
  std::vector<Index> parent(n, -1);
  std::vector<Index> ancestor(n, -1);
  for (Index k = 0; k < n; ++k) {
    const Index node = order[k];
    for (Index e = graph.start[node]; e < graph.start[node + 1]; ++e) {
      Index i = rank[graph.neighbor[e]];
      while (i != -1 && i < k) {
        const Index next = ancestor[i];
        ancestor[i] = k;
        if (next == -1) parent[i] = k;
        i = next;
      }
    }
  }
  return parent;
}

/// Columns in postorder, children in ascending order.
std::vector<Index> postorder(const std::vector<Index>& parent) {
  const auto n = static_cast<Index>(parent.size());
  std::vector<Index> first_child(n + 1, -1);
  std::vector<Index> next_sibling(n, -1);
  for (Index k = n - 1; k >= 0; --k) {
    const Index p = parent[k] == -1 ? n : parent[k];  // node n is a common parent of all roots
    next_sibling[k] = first_child[p];
    first_child[p] = k;
  }
  std::vector<Index> result;
  result.reserve(n);
  std::vector<Index> stack{n};
  while (!stack.empty()) {
    const Index k = stack.back();
    if (first_child[k] != -1) {
      stack.push_back(first_child[k]);
      first_child[k] = next_sibling[first_child[k]];
    } else {
      if (k != n) result.push_back(k);
      stack.pop_back();
    }
  }
  return result;
}

/// Heights of the columns. Row i of L is a subtree, between i and its neighbors below it in the tree.
/// Each leaf of the subtree adds a path up to its joint with the path of the previous leaf. Only the two
/// ends of each path are counted, and the counts are summed up the tree (Gilbert, Ng, Peyton 1994).
std::vector<Index> heights(const Graph& graph, const EliminationTree& tree) {
  const Index n = graph.size();
  std::vector<Index> height(n, 0);
  std::vector<Index> first(n, -1);  // first column in the subtree of each column
  for (Index k = 0; k < n; ++k) {
    if (first[k] == -1) height[k] = 1;
    for (Index j = k; j != -1 && first[j] == -1; j = tree.parent[j]) first[j] = k;
  }
  std::vector<Index> highest_first(n, -1);  // largest `first` among the leaves of a row so far
  std::vector<Index> last_leaf(n, -1);
  std::vector<Index> ancestor(n);  // root of the visited part, with path compression
  for (Index k = 0; k < n; ++k) ancestor[k] = k;
  for (Index k = 0; k < n; ++k) {
    const Index parent = tree.parent[k];
    if (parent != -1) --height[parent];
    const Index node = tree.order[k];
    for (Index e = graph.start[node]; e < graph.start[node + 1]; ++e) {
      const Index i = tree.rank[graph.neighbor[e]];
      if (i <= k || first[k] <= highest_first[i]) continue;
      highest_first[i] = first[k];
      ++height[k];
      const Index leaf = std::exchange(last_leaf[i], k);
      if (leaf == -1) continue;
      Index joint = leaf;
      while (joint != ancestor[joint]) joint = ancestor[joint];
      for (Index j = leaf; j != joint;) j = std::exchange(ancestor[j], joint);
      --height[joint];
    }
    if (parent != -1) ancestor[k] = parent;
  }
  for (Index k = 0; k < n; ++k) {
    if (tree.parent[k] != -1) height[tree.parent[k]] += height[k];
  }
  return height;
}

}  // namespace

EliminationTree eliminate(const Graph& graph, std::vector<Index> order) {
  const Index n = graph.size();
  const std::vector<Index> unordered = parents(graph, order, inverse(order));
  const std::vector<Index> post = postorder(unordered);
  const std::vector<Index> place = inverse(post);

  EliminationTree tree;
  tree.order.resize(n);
  tree.parent.resize(n);
  for (Index k = 0; k < n; ++k) {
    tree.order[k] = order[post[k]];
    tree.parent[k] = unordered[post[k]] == -1 ? -1 : place[unordered[post[k]]];
  }
  tree.rank = inverse(tree.order);
  tree.height = heights(graph, tree);
  return tree;
}

}  // namespace diffcloth::linalg
