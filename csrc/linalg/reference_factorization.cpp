#include "linalg/reference_factorization.h"

#include <algorithm>
#include <chrono>
#include <vector>

#include <Eigen/SparseCholesky>

namespace diffcloth::linalg {

double reference_factorization_seconds(const BlockMatrix& A, int repeats) {
  const BlockPattern& pattern = A.pattern();

  std::vector<Eigen::Triplet<double>> entries;
  for (Index j = 0; j < pattern.size(); ++j) {
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      const Eigen::Map<const Mat3> block(A.blocks() + 9 * static_cast<std::ptrdiff_t>(k));
      for (Index a = 0; a < 3; ++a) {
        for (Index b = 0; b < 3; ++b) {
          if (3 * i + a >= 3 * j + b) entries.emplace_back(3 * i + a, 3 * j + b, block(a, b));
        }
      }
    }
  }
  Eigen::SparseMatrix<double> matrix(3 * pattern.size(), 3 * pattern.size());
  matrix.setFromTriplets(entries.begin(), entries.end());
  Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>, Eigen::Lower> factor;
  factor.analyzePattern(matrix);

  std::vector<double> seconds;
  for (int repeat = 0; repeat < repeats; ++repeat) {
    const auto start = std::chrono::steady_clock::now();
    factor.factorize(matrix);
    seconds.push_back(
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
  }
  std::ranges::sort(seconds);
  return seconds[seconds.size() / 2];
}

}  // namespace diffcloth::linalg
