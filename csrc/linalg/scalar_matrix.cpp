#include "linalg/scalar_matrix.h"

#include <algorithm>

namespace diffcloth::linalg {

ScalarMatrix::ScalarMatrix(const Elimination& elimination) {
  const auto& [pattern, graph, tree] = elimination;
  const Index n = graph.size();
  std::vector<Index> rank(pattern.size(), -1);
  for (Index k = 0; k < n; ++k) {
    const Index vertex = graph.vertex[tree.order[k]];
    rank[vertex] = k;
    for (Index axis = 0; axis < 3; ++axis) unknown.push_back(3 * vertex + axis);
  }

  struct Block {
    Index row, slot;
    bool transposed;
  };
  std::vector<std::vector<Block>> columns(n);
  for (Index j = 0; j < pattern.size(); ++j) {
    if (rank[j] < 0) continue;
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (rank[i] < 0) continue;
      columns[std::min(rank[i], rank[j])].push_back(
          {.row = std::max(rank[i], rank[j]), .slot = k, .transposed = rank[i] < rank[j]});
    }
  }
  column_start.push_back(0);
  for (Index j = 0; j < n; ++j) {
    std::ranges::sort(columns[j], {}, &Block::row);
    for (Index b = 0; b < 3; ++b) {
      for (const Block& block : columns[j]) {
        for (Index a = block.row == j ? b : 0; a < 3; ++a) {
          row.push_back(3 * block.row + a);
          source.push_back(9 * block.slot + (block.transposed ? b + 3 * a : a + 3 * b));
        }
      }
      column_start.push_back(static_cast<Index>(row.size()));
    }
  }
}

std::size_t ScalarMatrix::bytes() const {
  return sizeof(*this) + sizeof(Index) * (column_start.capacity() + row.capacity() +
                                          source.capacity() + unknown.capacity());
}

void ScalarMatrix::gather(const double* blocks, std::vector<double>& values) const {
  values.resize(source.size());
  for (std::size_t k = 0; k < source.size(); ++k) values[k] = blocks[source[k]];
}

}  // namespace diffcloth::linalg
