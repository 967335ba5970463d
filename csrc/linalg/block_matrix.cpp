#include "linalg/block_matrix.h"

#include <algorithm>

namespace diffcloth::linalg {

MergedPattern merge(const BlockPattern& base, std::vector<std::pair<Index, Index>> pairs) {
  const auto by_column = [](const auto& a, const auto& b) {
    return a.second != b.second ? a.second < b.second : a.first < b.first;
  };
  std::ranges::sort(pairs, by_column);
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());

  const std::vector<Index>& start = base.column_start();
  const std::vector<Index>& row = base.row();
  std::vector<Index> merged_start(start.size(), 0);
  std::vector<Index> merged_row;
  merged_row.reserve(row.size() + pairs.size());
  std::vector<Index> slot_of_base(row.size());

  auto pair = pairs.begin();
  for (Index j = 0; j < base.size(); ++j) {
    Index k = start[j];
    while (k < start[j + 1] || (pair != pairs.end() && pair->second == j)) {
      const bool from_pairs = pair != pairs.end() && pair->second == j;
      if (from_pairs && (k == start[j + 1] || pair->first < row[k])) {
        merged_row.push_back(pair->first);
        ++pair;
      } else {
        if (from_pairs && pair->first == row[k]) ++pair;
        slot_of_base[k] = static_cast<Index>(merged_row.size());
        merged_row.push_back(row[k]);
        ++k;
      }
    }
    merged_start[j + 1] = static_cast<Index>(merged_row.size());
  }
  return {.pattern = BlockPattern(std::move(merged_start), std::move(merged_row)),
          .slot_of_base = std::move(slot_of_base)};
}

void add_product(const BlockPattern& pattern, const double* blocks, const double* x, double* y) {
  const std::vector<Index>& start = pattern.column_start();
  const std::vector<Index>& row = pattern.row();
  for (Index j = 0; j < pattern.size(); ++j) {
    const Vec3 x_j(x[3 * j], x[3 * j + 1], x[3 * j + 2]);
    Vec3 y_j = Eigen::Map<const Mat3>(blocks + 9 * static_cast<std::ptrdiff_t>(start[j])) * x_j;
    for (Index k = start[j] + 1; k < start[j + 1]; ++k) {
      const Index i = row[k];
      const Eigen::Map<const Mat3> block(blocks + 9 * static_cast<std::ptrdiff_t>(k));
      Eigen::Map<Vec3>(y + 3 * i) += block * x_j;
      y_j += block.transpose() * Eigen::Map<const Vec3>(x + 3 * i);
    }
    Eigen::Map<Vec3>(y + 3 * j) += y_j;
  }
}

}  // namespace diffcloth::linalg
