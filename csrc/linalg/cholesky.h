#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "linalg/block_pattern.h"

namespace diffcloth::linalg {

/// Symbolic part of A = L L^T for a block pattern with some vertices eliminated.
///
/// Holds the fill-reducing order (approximate minimum degree on the vertex graph, so nine times
/// cheaper than on the scalar one) and where each scalar of the permuted lower triangle comes from.
/// Immutable; shared by any number of factors and threads.
class CholeskyAnalysis {
 public:
  /// @param fixed  [pattern.size()] vertices left out of the matrix
  CholeskyAnalysis(const BlockPattern& pattern, const std::vector<char>& fixed);

  Index dimension() const { return static_cast<Index>(column_start.size()) - 1; }

  // The permuted lower triangle in compressed columns; source[k] is the place of scalar k among the
  // pattern's block values; unknown[k] is the coordinate (3 vertex + axis) of permuted unknown k.
  std::vector<Index> column_start;
  std::vector<Index> row;
  std::vector<Index> source;
  std::vector<Index> unknown;

  struct Backend;
  std::unique_ptr<Backend> backend;

  ~CholeskyAnalysis();
  CholeskyAnalysis(const CholeskyAnalysis&) = delete;
  CholeskyAnalysis& operator=(const CholeskyAnalysis&) = delete;

 private:
  /// Lay the matrix out with the vertices in this order.
  void permute(const BlockPattern& pattern, const std::vector<Index>& order);
};

/// A = L L^T: CHOLMOD's supernodal factorization where the build has it, Eigen's otherwise.
///
/// L L^T and not L D L^T: only the former reports an indefinite matrix.
class CholeskyFactor {
 public:
  explicit CholeskyFactor(std::shared_ptr<const CholeskyAnalysis> analysis);
  ~CholeskyFactor();
  CholeskyFactor(const CholeskyFactor&) = delete;
  CholeskyFactor& operator=(const CholeskyFactor&) = delete;

  /// Factor the matrix with these block values. False when it is not positive definite.
  [[nodiscard]] bool compute(const double* blocks);

  /// x = A^-1 b over 3 * vertex_count coordinates; rows of eliminated vertices are left as they are.
  /// Thread-safe.
  void solve(const double* b, double* x) const;

  /// Memory of the factor [bytes].
  std::size_t bytes() const;

 private:
  std::shared_ptr<const CholeskyAnalysis> analysis_;
  struct Backend;
  std::unique_ptr<Backend> backend_;
  std::vector<double> values_;
};

/// "cholmod 3.0.14" or "eigen".
const char* factorization_name();

}  // namespace diffcloth::linalg
