#include "linalg/block_pattern.h"

#include <algorithm>

namespace diffcloth::linalg {

BlockPattern::BlockPattern(Index vertex_count, const std::vector<std::vector<Index>>& cliques) {
  std::vector<std::pair<Index, Index>> pairs;
  for (const std::vector<Index>& clique : cliques) {
    for (const Index a : clique) {
      for (const Index b : clique) {
        if (a > b) pairs.emplace_back(a, b);
      }
    }
  }
  *this = from_pairs(vertex_count, std::move(pairs));
}

BlockPattern BlockPattern::from_pairs(Index vertex_count,
                                      std::vector<std::pair<Index, Index>> pairs) {
  for (Index i = 0; i < vertex_count; ++i) pairs.emplace_back(i, i);
  std::ranges::sort(pairs, [](const auto& a, const auto& b) {
    return a.second != b.second ? a.second < b.second : a.first < b.first;
  });
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());

  BlockPattern pattern;
  pattern.column_start_.assign(static_cast<std::size_t>(vertex_count) + 1, 0);
  pattern.row_.reserve(pairs.size());
  for (const auto& [row, column] : pairs) {
    ++pattern.column_start_[column + 1];
    pattern.row_.push_back(row);
  }
  for (Index j = 0; j < vertex_count; ++j) {
    pattern.column_start_[j + 1] += pattern.column_start_[j];
  }
  return pattern;
}

Index BlockPattern::slot(Index i, Index j) const {
  // Binary search for the lower bound of i; branch-free, because the half that contains it is
  // unpredictable.
  const Index* first = row_.data() + column_start_[j];
  for (Index count = column_start_[j + 1] - column_start_[j]; count > 0;) {
    const Index half = (count + 1) / 2;
    first += half * static_cast<Index>(first[half - 1] < i);
    count -= half;
  }
  return static_cast<Index>(first - row_.data());
}

std::vector<Index> BlockPattern::slots(std::span<const Index> clique) const {
  std::vector<Index> result;
  result.reserve(clique.size() * (clique.size() + 1) / 2);
  for (std::size_t p = 0; p < clique.size(); ++p) {
    for (std::size_t q = 0; q <= p; ++q) {
      result.push_back(slot(std::max(clique[p], clique[q]), std::min(clique[p], clique[q])));
    }
  }
  return result;
}

}  // namespace diffcloth::linalg
