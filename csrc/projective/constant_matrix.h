#pragma once

#include <cstddef>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "common/types.h"
#include "linalg/block_pattern.h"

namespace diffcloth::projective {

/// Unknown vertices of Projective Dynamics, in the order of elimination, and the pattern of its matrix:
/// all data that does not depend on values.
struct ConstantAnalysis {
  /// @param pattern  of the matrices' values; rows beyond the vertices are left out
  /// @param fixed    [N] pins: eliminated
  ConstantAnalysis(const linalg::BlockPattern& pattern, const std::vector<char>& fixed);

  Index vertex_count;         ///< N
  std::vector<Index> vertex;  ///< [rows] vertex of each row

  // The lower triangle in compressed columns, the diagonal first, and the slot of each entry.
  std::vector<Index> column_start;
  std::vector<Index> row;
  std::vector<Index> slot;
};

/// The constant matrix of Projective Dynamics  A = M/h^2 + L  over the free vertices (Bouaziz et al.
/// 2014; the paper's Eq. 3), the same for all three axes, factored.
class ConstantMatrix {
 public:
  using Scratch = std::vector<Vec4>;

  /// @param values  of A, one a slot of the analysis' pattern [N/m]
  /// @throws std::domain_error  if A is not positive definite in float64
  ConstantMatrix(std::shared_ptr<const ConstantAnalysis> analysis, std::vector<double> values);

  const std::vector<double>& values() const { return values_; }

  /// The free vertices.
  const std::vector<Index>& vertices() const { return analysis_->vertex; }

  /// x = A^-1 b, [N, 3]; zero at pins. b and x may alias.
  void solve(const double* b, double* x, Scratch& scratch) const;

  /// Memory of the matrix and its factor [bytes].
  std::size_t bytes() const;

 private:
  std::shared_ptr<const ConstantAnalysis> analysis_;
  std::vector<double> values_;

  // A = F F^T: below the diagonal in compressed columns, and the inverse diagonal.
  std::vector<Index> start_;
  std::vector<Index> row_;
  std::vector<double> factor_;
  std::vector<double> inverse_diagonal_;
};

/// Cache of constant matrices, by their values.
///
/// Bounded in bytes. A matrix is a function of its values, so the content of the cache does not affect
/// results. Thread-safe.
class ConstantMatrixCache {
 public:
  /// See ConstantAnalysis. The pattern must outlive the cache.
  ConstantMatrixCache(const linalg::BlockPattern& pattern, std::vector<char> fixed);
  ConstantMatrixCache(const ConstantMatrixCache&) = delete;
  ConstantMatrixCache& operator=(const ConstantMatrixCache&) = delete;

  std::shared_ptr<const ConstantMatrix> find(const std::vector<double>& values);

 private:
  static constexpr std::size_t kCapacity = std::size_t{32} << 20;  // [bytes]

  const linalg::BlockPattern& pattern_;
  std::vector<char> fixed_;
  std::mutex mutex_;
  std::shared_ptr<const ConstantAnalysis> analysis_;           // created when first needed
  std::list<std::shared_ptr<const ConstantMatrix>> matrices_;  // most recent first
  std::size_t bytes_ = 0;
};

}  // namespace diffcloth::projective
