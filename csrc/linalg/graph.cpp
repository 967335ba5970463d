#include "linalg/graph.h"

namespace diffcloth::linalg {
namespace {

/// Call visit(i, j) for the nodes of each coupling i > j, by j, then by i.
template <class Visit>
void for_each_coupling(const BlockPattern& pattern, const std::vector<Index>& node, Visit visit) {
  for (Index j = 0; j < pattern.size(); ++j) {
    if (node[j] < 0) continue;
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (i != j && node[i] >= 0) visit(node[i], node[j]);
    }
  }
}

}  // namespace

Graph unknown_graph(const BlockPattern& pattern, const std::vector<char>& fixed) {
  Graph graph;
  std::vector<Index> node(pattern.size(), -1);
  for (Index i = 0; i < pattern.size(); ++i) {
    if (fixed[i]) continue;
    node[i] = graph.size();
    graph.vertex.push_back(i);
  }
  graph.start.assign(graph.vertex.size() + 1, 0);
  for_each_coupling(pattern, node, [&](Index i, Index j) {
    ++graph.start[i + 1];
    ++graph.start[j + 1];
  });
  for (Index k = 0; k < graph.size(); ++k) graph.start[k + 1] += graph.start[k];
  graph.neighbor.resize(static_cast<std::size_t>(graph.start.back()));

  // Smaller neighbors are visited in the order of the columns; then the larger ones of each column.
  std::vector<Index> next = graph.start;
  for_each_coupling(pattern, node, [&](Index i, Index j) { graph.neighbor[next[i]++] = j; });
  for_each_coupling(pattern, node, [&](Index i, Index j) { graph.neighbor[next[j]++] = i; });
  return graph;
}

}  // namespace diffcloth::linalg
