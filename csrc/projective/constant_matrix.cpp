#include "projective/constant_matrix.h"

#include <algorithm>
#include <stdexcept>
#include <utility>

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCholesky>

namespace diffcloth::projective {
namespace {

using Sparse = Eigen::SparseMatrix<double, Eigen::ColMajor, Index>;

/// Rank of each free vertex in a fill-reducing order; -1 for other vertices.
std::vector<Index> elimination_order(const linalg::BlockPattern& pattern,
                                     const std::vector<char>& fixed) {
  const auto n = static_cast<Index>(fixed.size());
  std::vector<Index> rank(fixed.size(), -1);
  Index count = 0;
  for (Index i = 0; i < n; ++i) {
    if (fixed[i] == 0) rank[i] = count++;
  }
  std::vector<Eigen::Triplet<double, Index>> entries;
  for (Index j = 0; j < n; ++j) {
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (rank[i] >= 0 && rank[j] >= 0) entries.emplace_back(rank[i], rank[j], 1.0);
    }
  }
  Sparse graph(count, count);
  graph.setFromTriplets(entries.begin(), entries.end());
  Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, Index> inverse;
  Eigen::AMDOrdering<Index>()(graph.selfadjointView<Eigen::Lower>(), inverse);
  std::vector<Index> place(static_cast<std::size_t>(count));
  for (Index k = 0; k < count; ++k) place[inverse.indices()[k]] = k;
  for (Index& r : rank) {
    if (r >= 0) r = place[r];
  }
  return rank;
}

}  // namespace

ConstantAnalysis::ConstantAnalysis(const linalg::BlockPattern& pattern,
                                   const std::vector<char>& fixed)
    : vertex_count(static_cast<Index>(fixed.size())) {
  const std::vector<Index> rank = elimination_order(pattern, fixed);
  const auto count =
      static_cast<std::size_t>(std::ranges::count_if(rank, [](Index r) { return r >= 0; }));
  struct Entry {
    Index row, slot;
  };
  std::vector<std::vector<Entry>> columns(count);
  vertex.resize(count);
  for (Index j = 0; j < vertex_count; ++j) {
    if (rank[j] < 0) continue;
    vertex[rank[j]] = j;
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (rank[i] < 0) continue;
      columns[std::min(rank[i], rank[j])].push_back({.row = std::max(rank[i], rank[j]), .slot = k});
    }
  }
  column_start.push_back(0);
  for (std::vector<Entry>& column : columns) {
    std::ranges::sort(column, {}, &Entry::row);
    for (const Entry& entry : column) {
      row.push_back(entry.row);
      slot.push_back(entry.slot);
    }
    column_start.push_back(static_cast<Index>(row.size()));
  }
}

ConstantMatrix::ConstantMatrix(std::shared_ptr<const ConstantAnalysis> analysis,
                               std::vector<double> values)
    : analysis_(std::move(analysis)), values_(std::move(values)) {
  const ConstantAnalysis& a = *analysis_;
  const auto n = static_cast<Index>(a.vertex.size());
  std::vector<double> entries(a.slot.size());
  for (std::size_t k = 0; k < entries.size(); ++k) entries[k] = values_[a.slot[k]];
  const Eigen::Map<const Sparse> lower(n, n, static_cast<Index>(entries.size()),
                                       a.column_start.data(), a.row.data(), entries.data());
  // The rows are already in the order of elimination.
  Eigen::SimplicialLLT<Sparse, Eigen::Lower, Eigen::NaturalOrdering<Index>> cholesky;
  cholesky.compute(lower);
  if (cholesky.info() != Eigen::Success) {
    throw std::domain_error(
        "the constant matrix of Projective Dynamics is not positive definite: the stiffnesses of "
        "the scene differ by more than float64 can hold");
  }
  const Sparse& L = cholesky.matrixL().nestedExpression();
  inverse_diagonal_.reserve(static_cast<std::size_t>(n));
  start_.push_back(0);
  for (Index j = 0; j < n; ++j) {
    // The diagonal comes first in each column.
    const Index first = L.outerIndexPtr()[j];
    inverse_diagonal_.push_back(1.0 / L.valuePtr()[first]);
    for (Index k = first + 1; k < L.outerIndexPtr()[j + 1]; ++k) {
      row_.push_back(L.innerIndexPtr()[k]);
      factor_.push_back(L.valuePtr()[k]);
    }
    start_.push_back(static_cast<Index>(row_.size()));
  }
}

// The three axes are processed together, padded to four numbers a row.
void ConstantMatrix::solve(const double* b, double* x, Scratch& y) const {
  const std::vector<Index>& vertex = analysis_->vertex;
  const auto n = static_cast<Index>(vertex.size());
  y.resize(vertex.size());
  for (Index j = 0; j < n; ++j) y[j] << diffcloth::row(b, vertex[j]), 0.0;
  for (Index j = 0; j < n; ++j) {
    const Vec4 y_j = inverse_diagonal_[j] * y[j];
    y[j] = y_j;
    for (Index k = start_[j]; k < start_[j + 1]; ++k) y[row_[k]] -= factor_[k] * y_j;
  }
  for (Index j = n; j-- > 0;) {
    Vec4 y_j = y[j];
    for (Index k = start_[j]; k < start_[j + 1]; ++k) y_j -= factor_[k] * y[row_[k]];
    y[j] = inverse_diagonal_[j] * y_j;
  }
  std::fill_n(x, 3 * static_cast<std::size_t>(analysis_->vertex_count), 0.0);
  for (Index j = 0; j < n; ++j) Eigen::Map<Vec3>(x + 3 * vertex[j]) = y[j].head<3>();
}

std::size_t ConstantMatrix::bytes() const {
  return sizeof(*this) + sizeof(Index) * (start_.capacity() + row_.capacity()) +
         sizeof(double) * (values_.capacity() + factor_.capacity() + inverse_diagonal_.capacity());
}

ConstantMatrixCache::ConstantMatrixCache(const linalg::BlockPattern& pattern,
                                         std::vector<char> fixed)
    : pattern_(pattern), fixed_(std::move(fixed)) {}

std::shared_ptr<const ConstantMatrix> ConstantMatrixCache::find(const std::vector<double>& values) {
  std::shared_ptr<const ConstantAnalysis> analysis;
  {
    const std::lock_guard lock(mutex_);
    for (auto entry = matrices_.begin(); entry != matrices_.end(); ++entry) {
      if ((*entry)->values() != values) continue;
      matrices_.splice(matrices_.begin(), matrices_, entry);
      return matrices_.front();
    }
    if (!analysis_) analysis_ = std::make_shared<const ConstantAnalysis>(pattern_, fixed_);
    analysis = analysis_;
  }
  auto matrix = std::make_shared<const ConstantMatrix>(std::move(analysis), values);
  const std::lock_guard lock(mutex_);
  matrices_.push_front(matrix);
  bytes_ += matrix->bytes();
  while (bytes_ > kCapacity && matrices_.size() > 1) {
    bytes_ -= matrices_.back()->bytes();
    matrices_.pop_back();
  }
  return matrix;
}

}  // namespace diffcloth::projective
