#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "common/team.h"
#include "linalg/aligned_buffer.h"
#include "linalg/block_pattern.h"
#include "linalg/dense_kernels.h"
#include "linalg/ordering.h"

namespace diffcloth::linalg {

/// Implementation of the factorization.
enum class Backend : std::uint8_t {
  kMultifrontal,  ///< our own implementation, without a BLAS
  kEigen,         ///< Eigen's SimplicialLLT
  kCholmod,       ///< CHOLMOD's supernodal factorization; optional in a build
};

const char* name(Backend backend);

/// The backends of this build.
const std::vector<Backend>& available_backends();

/// Backend chosen at build time (DIFFCLOTH_FACTORIZATION); kMultifrontal by default.
Backend default_backend();

/// Name of the default backend, with its kernel level: "multifrontal (avx512)".
std::string factorization_name();

class AnalysisBackend;
class FactorBackend;

/// Temporary memory and threads of factorizations and solves. Keep one for each environment and pass it
/// to every compute() and solve(): its memory grows to the largest demand and is not released.
class CholeskyWorkspace {
 public:
  /// @param threads  threads that share large factorizations and solves; results do not depend on them
  explicit CholeskyWorkspace(int threads = 1) : team_(threads) {}

  /// Uninitialized memory for at least `size` numbers.
  template <class Real>
  Real* reserve(std::size_t size) {
    return static_cast<Real*>(reserve_bytes(size * sizeof(Real)));
  }

  std::size_t bytes() const { return buffer_.bytes(); }

  Team& team() { return team_; }

  /// Room for factors that are created during the life of this workspace.
  const std::shared_ptr<SpareRoom>& room() const { return room_; }

 private:
  void* reserve_bytes(std::size_t size);

  AlignedBuffer<std::byte> buffer_;
  Team team_;
  std::shared_ptr<SpareRoom> room_ = std::make_shared<SpareRoom>();
};

/// Time of multifrontal factorizations by phase, on the caller's thread [s].
struct CholeskySeconds {
  double assembly = 0.0;    ///< the matrix into panels
  double extend_add = 0.0;  ///< update matrices of children into their parents
  double dense = 0.0;       ///< columns of L and update matrices
};

/// Options for tests and benchmarks.
struct CholeskyOptions {
  KernelLevel level = chosen_level();  ///< for the multifrontal backend
  Ordering ordering = Ordering::kAutomatic;
};

/// Symbolic part of A = L L^T for a block pattern with some vertices left out.
///
/// The analysis works on the graph of the vertices, which is nine times smaller than the graph of the
/// scalars. Immutable; shared by any number of factors and threads.
class CholeskyAnalysis {
 public:
  /// @param fixed  [pattern.size()] vertices left out of the matrix
  CholeskyAnalysis(const BlockPattern& pattern,
                   const std::vector<char>& fixed,
                   Backend backend = default_backend(),
                   const CholeskyOptions& options = {});
  ~CholeskyAnalysis();
  CholeskyAnalysis(const CholeskyAnalysis&) = delete;
  CholeskyAnalysis& operator=(const CholeskyAnalysis&) = delete;

  /// Number of unknown scalars.
  Index dimension() const;

  /// Memory of the analysis [bytes].
  std::size_t bytes() const;

  /// Number of entries of L, including stored zeros.
  std::size_t nonzeros() const;

  /// Floating-point operations of one factorization.
  double flops() const;

  const AnalysisBackend& backend() const { return *backend_; }

 private:
  std::unique_ptr<const AnalysisBackend> backend_;
};

/// Factorization A = L L^T; in contrast to L D L^T it detects an indefinite matrix.
///
/// A factor in single precision takes half the time and memory of one in doubles, and its solutions have
/// a relative error of 6e-8 times the condition number: as a preconditioner it is as good. Rows and
/// columns are scaled by powers of two, so that units do not matter, and numbers below 1e-38 relative to
/// the diagonal are zero.
class CholeskyFactor {
 public:
  /// @param precision  requested precision; only kMultifrontal supports kSingle
  /// @param room       memory for large arrays, of the workspace used with the factor; else a room of
  /// its own
  explicit CholeskyFactor(std::shared_ptr<const CholeskyAnalysis> analysis,
                          Precision precision = Precision::kDouble,
                          const std::shared_ptr<SpareRoom>& room = std::make_shared<SpareRoom>());
  ~CholeskyFactor();
  CholeskyFactor(const CholeskyFactor&) = delete;
  CholeskyFactor& operator=(const CholeskyFactor&) = delete;

  /// Factor the matrix with these block values; of diagonal blocks only the lower triangles are read.
  /// Returns as soon as the matrix is found to be not positive definite, or unclear; the factor must
  /// then not be used until another compute() has succeeded.
  ///
  /// @param seconds  if given, times are added; only kMultifrontal does so
  [[nodiscard]] Verdict compute(const double* blocks,
                                CholeskyWorkspace& workspace,
                                CholeskySeconds* seconds = nullptr);

  /// Factor with a temporary workspace.
  [[nodiscard]] Verdict compute(const double* blocks);

  /// x = A^-1 b over 3 * vertex_count coordinates; rows of left-out vertices are unchanged. Thread-safe
  /// if each thread has its own workspace.
  void solve(const double* b, double* x, CholeskyWorkspace& workspace) const;

  /// x[r] = A^-1 b[r] for several right-hand sides, each with the same bits as alone.
  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& workspace) const;

  /// Solve with a temporary workspace.
  void solve(const double* b, double* x) const;
  void solve(std::span<const double* const> b, std::span<double* const> x) const;

  const std::shared_ptr<const CholeskyAnalysis>& analysis() const { return analysis_; }

  /// Precision of the factor, which may differ from the requested one.
  Precision precision() const;

  /// Memory of the factor, without the analysis [bytes].
  std::size_t bytes() const;

 private:
  std::shared_ptr<const CholeskyAnalysis> analysis_;
  std::unique_ptr<FactorBackend> backend_;
  Verdict verdict_ = Verdict::kUnclear;
};

}  // namespace diffcloth::linalg
