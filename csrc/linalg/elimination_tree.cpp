#include "linalg/elimination_tree.h"

namespace diffcloth::linalg {
namespace {

std::vector<Index> inverse(const std::vector<Index>& order) {
  std::vector<Index> rank(order.size());
  for (std::size_t k = 0; k < order.size(); ++k) rank[order[k]] = static_cast<Index>(k);
  return rank;
}

/// Parents by Liu's algorithm: paths to roots found so far are compressed.
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
    const Index p = parent[k] == -1 ? n : parent[k];  // node n stands above all roots
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

/// Heights of the columns: row i of L is the part of the tree between i and its neighbors below.
std::vector<Index> heights(const Graph& graph, const EliminationTree& tree) {
  const Index n = graph.size();
  std::vector<Index> height(n, 1);
  std::vector<Index> last_row(n, -1);
  for (Index i = 0; i < n; ++i) {
    last_row[i] = i;
    const Index node = tree.order[i];
    for (Index e = graph.start[node]; e < graph.start[node + 1]; ++e) {
      Index k = tree.rank[graph.neighbor[e]];
      if (k > i) continue;
      for (; last_row[k] != i; k = tree.parent[k]) {
        last_row[k] = i;
        ++height[k];
      }
    }
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
