#include <cmath>

#include <Eigen/SparseCholesky>

#include "linalg/backend.h"
#include "linalg/scalar_matrix.h"

namespace diffcloth::linalg {
namespace {

using Sparse = Eigen::SparseMatrix<double, Eigen::ColMajor, Index>;

/// Gives access to the pattern of L after the analysis; matrixL() requires its values.
class Solver final
    : public Eigen::SimplicialLLT<Sparse, Eigen::Lower, Eigen::NaturalOrdering<Index>> {
 public:
  const Sparse& lower() const { return m_matrix; }
};

Eigen::Map<const Sparse> view(const ScalarMatrix& matrix, const double* values) {
  return {matrix.dimension(),         matrix.dimension(), static_cast<Index>(matrix.row.size()),
          matrix.column_start.data(), matrix.row.data(),  values};
}

class EigenFactor final : public FactorBackend {
 public:
  explicit EigenFactor(const ScalarMatrix& matrix) : matrix_(matrix) {
    values_.assign(matrix.row.size(), 1.0);
    if (matrix.dimension() > 0) solver_.analyzePattern(view(matrix_, values_.data()));
  }

  Verdict compute(const double* blocks,
                  CholeskyWorkspace& /*workspace*/,
                  CholeskySeconds* /*seconds*/) override {
    if (matrix_.dimension() == 0) return Verdict::kPositive;
    matrix_.gather(blocks, values_);
    solver_.factorize(view(matrix_, values_.data()));
    // Eigen compares pivots with zero, which NaN passes; a NaN then appears on the diagonal.
    const bool positive = solver_.info() == Eigen::Success && std::isfinite(trace());
    return positive ? Verdict::kPositive : Verdict::kIndefinite;
  }

  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& /*workspace*/) const override {
    if (matrix_.dimension() == 0) return;
    Eigen::VectorXd y(matrix_.dimension());
    for (std::size_t r = 0; r < b.size(); ++r) {
      for (Index k = 0; k < matrix_.dimension(); ++k) y[k] = b[r][matrix_.unknown[k]];
      const Eigen::VectorXd solution = solver_.solve(y);
      for (Index k = 0; k < matrix_.dimension(); ++k) x[r][matrix_.unknown[k]] = solution[k];
    }
  }

  std::size_t bytes() const override {
    // L, the tree and the counts of the columns, and the solver's work space.
    const auto n = static_cast<std::size_t>(matrix_.dimension());
    return sizeof(*this) + values_.capacity() * sizeof(double) +
           (sizeof(double) + sizeof(Index)) * nonzeros() + 4 * n * sizeof(Index);
  }

  std::size_t nonzeros() const {
    if (matrix_.dimension() == 0) return 0;
    return static_cast<std::size_t>(solver_.lower().nonZeros());
  }

  double flops() const {
    if (matrix_.dimension() == 0) return 0.0;
    const Sparse& l = solver_.lower();
    double sum = 0.0;
    for (Index j = 0; j < l.outerSize(); ++j) {
      const double height = l.outerIndexPtr()[j + 1] - l.outerIndexPtr()[j];
      sum += height * height;
    }
    return sum;
  }

 private:
  double trace() const {
    const Sparse& l = solver_.lower();
    double sum = 0.0;
    for (Index j = 0; j < l.outerSize(); ++j) sum += l.valuePtr()[l.outerIndexPtr()[j]];
    return sum;
  }

  const ScalarMatrix& matrix_;
  std::vector<double> values_;
  Solver solver_;
};

class EigenAnalysis final : public AnalysisBackend {
 public:
  explicit EigenAnalysis(const Elimination& elimination) : matrix_(elimination) {
    const EigenFactor factor(matrix_);
    nonzeros_ = factor.nonzeros();
    flops_ = factor.flops();
  }

  std::unique_ptr<FactorBackend> make_factor(
      Precision /*precision*/, const std::shared_ptr<SpareRoom>& /*room*/) const override {
    return std::make_unique<EigenFactor>(matrix_);
  }
  Index dimension() const override { return matrix_.dimension(); }
  std::size_t nonzeros() const override { return nonzeros_; }
  double flops() const override { return flops_; }
  std::size_t bytes() const override { return sizeof(*this) + matrix_.bytes(); }

 private:
  ScalarMatrix matrix_;
  std::size_t nonzeros_;
  double flops_;
};

}  // namespace

std::unique_ptr<const AnalysisBackend> analyze_eigen(const Elimination& elimination) {
  return std::make_unique<EigenAnalysis>(elimination);
}

}  // namespace diffcloth::linalg
