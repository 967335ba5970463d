#include "linalg/block_matrix.h"

#include <algorithm>
#include <numeric>
#include <utility>

#include "linalg/dense_kernels.h"

namespace diffcloth::linalg {

Couplings beyond(const BlockPattern& base, const Couplings& pairs) {
  // Bucket sort by column; the few rows of each column are then sorted.
  const auto size = static_cast<std::size_t>(base.size());
  std::vector<Index> start(size + 1, 0);
  for (const auto& pair : pairs) ++start[pair.second + 1];
  std::partial_sum(start.begin(), start.end(), start.begin());
  std::vector<Index> row(pairs.size());
  for (const auto& pair : pairs) row[start[pair.second]++] = pair.first;
  Couplings result;
  std::vector<Index> known_in(size, -1);  // last column that contains this row
  Index first = 0;
  for (Index column = 0; column < base.size(); ++column) {
    const Index last = start[column];  // advanced to the end of its run by the loop above
    if (first == last) continue;
    for (Index k = base.column_start()[column]; k < base.column_start()[column + 1]; ++k) {
      known_in[base.row()[k]] = column;
    }
    const auto middle = static_cast<std::ptrdiff_t>(result.size());
    for (; first < last; ++first) {
      if (std::exchange(known_in[row[first]], column) != column) {
        result.emplace_back(row[first], column);
      }
    }
    std::sort(result.begin() + middle, result.end());
  }
  return result;
}

MergedPattern merge(const BlockPattern& base, const Couplings& pairs) {
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

BlockMatrix::BlockMatrix(std::shared_ptr<const MergedPattern> merged,
                         const std::vector<char>& fixed,
                         const Attachments* attachments)
    : BlockValues(std::move(merged)), fixed_(&fixed), attachments_(attachments) {}

void BlockMatrix::add_terms(std::span<const Index> points, const StencilTerms& of) {
  static const AddStencil add = stencil_kernel(chosen_level());
  std::array<Index, kStencilPoints> rows;
  bool any = false;
  for (std::size_t p = 0; p < points.size(); ++p) {
    rows[p] = has(points[p]) ? points[p] : -1;
    any = any || rows[p] >= 0;
  }
  if (!any) return;
  add(of, rows.data(), merged_->pattern.column_start().data(), merged_->pattern.row().data(),
      blocks_.data());
}

void BlockMatrix::add_attached(const std::array<Index, 4>& points, const Mat12& h) {
  motions_.clear();
  const Eigen::Matrix<double, 12, 3> none = Eigen::Matrix<double, 12, 3>::Zero();
  const auto find = [&](Index r) -> Motion& {
    for (Motion& known : motions_) {
      if (known.row == r) return known;
    }
    motions_.push_back({.row = r, .point = -1, .g = none});
    return motions_.back();
  };
  for (int p = 0; p < 4; ++p) {
    if (has(points[p])) {
      motions_.push_back({.row = points[p], .point = p, .g = none});
    } else if (is_attached(points[p])) {
      for (const auto* e = attachments_->begin(points[p]); e != attachments_->end(points[p]); ++e) {
        find(e->row).g.block<3, 3>(3 * p, 0) += e->jacobian;
      }
    }
  }
  for (const Motion& s : motions_) {
    // Lazy products are faster at this size.
    Eigen::Matrix<double, 12, 3> hg;
    if (s.point >= 0) {
      hg = h.middleCols<3>(3 * s.point);
    } else {
      hg = h.lazyProduct(s.g);
    }
    for (const Motion& r : motions_) {
      if (r.row < s.row) continue;
      if (r.point >= 0) {
        add_block(r.row, s.row, hg.middleRows<3>(3 * r.point));
      } else {
        add_block(r.row, s.row, r.g.transpose().lazyProduct(hg));
      }
    }
  }
}

void BlockMatrix::add_congruence(std::span<const Index> points,
                                 std::span<const Mat3> jacobians,
                                 const Mat3& core) {
  changes_.clear();
  const auto add = [&](Index r, const Mat3& change) {
    for (auto& [known, sum] : changes_) {
      if (known != r) continue;
      sum += change;
      return;
    }
    changes_.emplace_back(r, change);
  };
  for (std::size_t p = 0; p < points.size(); ++p) {
    if (has(points[p])) {
      add(points[p], jacobians[p]);
    } else if (is_attached(points[p])) {
      for (const auto* e = attachments_->begin(points[p]); e != attachments_->end(points[p]); ++e) {
        add(e->row, jacobians[p].lazyProduct(e->jacobian));
      }
    }
  }
  for (const auto& [s, change_s] : changes_) {
    const Mat3 column = core.lazyProduct(change_s);
    for (const auto& [r, change_r] : changes_) {
      if (r >= s) add_block(r, s, change_r.transpose().lazyProduct(column));
    }
  }
}

void BlockMatrix::blend(const BlockMatrix& other, double s) {
  const double own = 1.0 / (1.0 + s);
  const double others = s / (1.0 + s);
  for (std::size_t k = 0; k < blocks_.size(); ++k) {
    blocks_[k] = own * blocks_[k] + others * other.blocks_[k];
  }
}

void BlockValues::add_product(const double* x, double* y) const { add_products({&x, 1}, {&y, 1}); }

void BlockValues::add_products(std::span<const double* const> x, std::span<double* const> y) const {
  linalg::add_products(merged_->pattern, blocks_.data(), x, y);
}

namespace {

const DenseKernels& kernels() {
  static const DenseKernels& best = dense_kernels(chosen_level());
  return best;
}

using Numbers = std::vector<double, RecyclingAllocator<double>>;

void add_one_product(const BlockPattern& pattern,
                     const double* blocks,
                     const double* x,
                     double* y) {
  const auto n = static_cast<std::size_t>(pattern.size());
  Numbers wide(8 * n);
  double* const wide_y = wide.data() + 4 * n;
  for (std::size_t i = 0; i < n; ++i) std::copy_n(x + 3 * i, 3, wide.data() + 4 * i);
  kernels().multiply_blocks(pattern.column_start().data(), pattern.row().data(), pattern.size(),
                            blocks, wide.data(), wide_y);
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t a = 0; a < 3; ++a) y[3 * i + a] += wide_y[4 * i + a];
  }
}

/// For at most kMaxVectors vectors.
void add_many_products(const BlockPattern& pattern,
                       const double* blocks,
                       std::span<const double* const> x,
                       std::span<double* const> y) {
  const std::size_t n = 3 * static_cast<std::size_t>(pattern.size());
  Numbers wide(2 * n * kMaxVectors);
  double* const wide_y = wide.data() + n * kMaxVectors;
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t r = 0; r < x.size(); ++r) wide[i * kMaxVectors + r] = x[r][i];
  }
  kernels().multiply_blocks_many(pattern.column_start().data(), pattern.row().data(),
                                 pattern.size(), blocks, wide.data(), wide_y);
  for (std::size_t i = 0; i < n; ++i) {
    for (std::size_t r = 0; r < y.size(); ++r) y[r][i] += wide_y[i * kMaxVectors + r];
  }
}

}  // namespace

void add_products(const BlockPattern& pattern,
                  const double* blocks,
                  std::span<const double* const> x,
                  std::span<double* const> y) {
  for (std::size_t begin = 0; begin < x.size();) {
    const std::size_t count = at_once(x.size() - begin);
    if (count == 1) {
      add_one_product(pattern, blocks, x[begin], y[begin]);
    } else {
      add_many_products(pattern, blocks, x.subspan(begin, count), y.subspan(begin, count));
    }
    begin += count;
  }
}

}  // namespace diffcloth::linalg
