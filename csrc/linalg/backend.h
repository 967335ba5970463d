#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "common/recycled_memory.h"
#include "linalg/block_pattern.h"
#include "linalg/dense_kernels.h"
#include "linalg/elimination_tree.h"
#include "linalg/graph.h"

namespace diffcloth::linalg {

class CholeskyWorkspace;
struct CholeskySeconds;

/// Values of a factorization; implementation behind CholeskyFactor.
class FactorBackend {
 public:
  FactorBackend() = default;
  virtual ~FactorBackend() = default;
  FactorBackend(const FactorBackend&) = delete;
  FactorBackend& operator=(const FactorBackend&) = delete;

  virtual Verdict compute(const double* blocks,
                          CholeskyWorkspace& workspace,
                          CholeskySeconds* seconds) = 0;
  virtual void solve(std::span<const double* const> b,
                     std::span<double* const> x,
                     CholeskyWorkspace& workspace) const = 0;
  virtual Precision precision() const { return Precision::kDouble; }
  virtual std::size_t bytes() const = 0;
};

/// Structure of a factorization; implementation behind CholeskyAnalysis. Must outlive its factors.
class AnalysisBackend {
 public:
  AnalysisBackend() = default;
  virtual ~AnalysisBackend() = default;
  AnalysisBackend(const AnalysisBackend&) = delete;
  AnalysisBackend& operator=(const AnalysisBackend&) = delete;

  /// @param precision  requested precision; a backend may support doubles only
  /// @param room       memory for large arrays
  virtual std::unique_ptr<FactorBackend> make_factor(
      Precision precision, const std::shared_ptr<SpareRoom>& room) const = 0;
  virtual Index dimension() const = 0;
  virtual std::size_t nonzeros() const = 0;
  virtual double flops() const = 0;
  virtual std::size_t bytes() const = 0;
};

/// A pattern and the order in which its vertices are eliminated.
struct Elimination {
  BlockPattern pattern;
  Graph graph;
  EliminationTree tree;
};

std::unique_ptr<const AnalysisBackend> analyze_multifrontal(Elimination elimination,
                                                            KernelLevel level);
std::unique_ptr<const AnalysisBackend> analyze_eigen(const Elimination& elimination);
std::unique_ptr<const AnalysisBackend> analyze_cholmod(const Elimination& elimination);

}  // namespace diffcloth::linalg
