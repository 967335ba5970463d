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

/// What factors a matrix.
enum class Backend : std::uint8_t {
  kMultifrontal,  ///< our own, without a BLAS
  kEigen,         ///< Eigen's SimplicialLLT
  kCholmod,       ///< CHOLMOD's supernodal factorization; where the build has it
};

const char* name(Backend backend);

/// The backends of this build.
const std::vector<Backend>& available_backends();

/// The backend that this build was told to use (DIFFCLOTH_FACTORIZATION): our own if nothing was said.
Backend default_backend();

/// What the default backend is in this process: "multifrontal (avx512)".
std::string factorization_name();

class AnalysisBackend;
class FactorBackend;

/// Memory and threads that factorizations and solves need while they run. Keep one for each
/// environment and pass it to every compute() and solve(): it grows to what the largest needs and stays
/// so.
class CholeskyWorkspace {
 public:
  /// @param threads  that large ones are shared by; they do not change a bit
  explicit CholeskyWorkspace(int threads = 1) : team_(threads) {}

  /// At least `size` numbers, of any values.
  template <class Real>
  Real* reserve(std::size_t size) {
    return static_cast<Real*>(reserve_bytes(size * sizeof(Real)));
  }

  std::size_t bytes() const { return buffer_.bytes(); }

  Team& team() { return team_; }

  /// For factors that are made while this one lives.
  const std::shared_ptr<SpareRoom>& room() const { return room_; }

 private:
  void* reserve_bytes(std::size_t size);

  AlignedBuffer<std::byte> buffer_;
  Team team_;
  std::shared_ptr<SpareRoom> room_ = std::make_shared<SpareRoom>();
};

/// Where the time of multifrontal factorizations went on the caller's thread [s].
struct CholeskySeconds {
  double assembly = 0.0;    ///< the matrix into panels
  double extend_add = 0.0;  ///< update matrices of children into their parents
  double dense = 0.0;       ///< columns of L and update matrices
};

/// What only tests and benchmarks choose.
struct CholeskyOptions {
  KernelLevel level = chosen_level();  ///< of our own kernels
  Ordering ordering = Ordering::kAutomatic;
};

/// Symbolic part of A = L L^T for a block pattern with some vertices left out.
///
/// Everything is done on the graph of the vertices, which is nine times smaller than that of the
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

  /// Unknown scalars.
  Index dimension() const;

  /// Memory of the analysis.
  std::size_t bytes() const;

  /// Entries of L, stored zeros included.
  std::size_t nonzeros() const;

  /// Operations of one factorization.
  double flops() const;

  const AnalysisBackend& backend() const { return *backend_; }

 private:
  std::unique_ptr<const AnalysisBackend> backend_;
};

/// A = L L^T, and not L D L^T: only the former reports an indefinite matrix.
///
/// In single precision it takes half the time and memory of one in doubles, and solves to the share of
/// rounding that the condition of the matrix makes of 6e-8: as a preconditioner it is as good. Rows and
/// columns are scaled by powers of two, so that units change nothing, and numbers below 1e-38 of
/// those of the diagonal are zero.
class CholeskyFactor {
 public:
  /// @param precision  that is asked for; backends other than ours have doubles only
  /// @param room       for what is large, of the workspace that is used with it; else its own
  explicit CholeskyFactor(std::shared_ptr<const CholeskyAnalysis> analysis,
                          Precision precision = Precision::kDouble,
                          const std::shared_ptr<SpareRoom>& room = std::make_shared<SpareRoom>());
  ~CholeskyFactor();
  CholeskyFactor(const CholeskyFactor&) = delete;
  CholeskyFactor& operator=(const CholeskyFactor&) = delete;

  /// Factor the matrix with these block values, of whose diagonal blocks the lower triangles count.
  /// It ends at once where that turns out not to be positive definite, or unclear; the factor must
  /// then not be used before another compute() has succeeded.
  ///
  /// @param seconds  if given, times are added to it; backends other than ours leave it alone
  [[nodiscard]] Verdict compute(const double* blocks,
                                CholeskyWorkspace& workspace,
                                CholeskySeconds* seconds = nullptr);

  /// The same with memory of its own for this call.
  [[nodiscard]] Verdict compute(const double* blocks);

  /// x = A^-1 b over 3 * vertex_count coordinates; rows of vertices left out stay as they are. May
  /// be called from any number of threads at once, each with its workspace.
  void solve(const double* b, double* x, CholeskyWorkspace& workspace) const;

  /// x[r] = A^-1 b[r] for several right-hand sides, with the bits of one at a time.
  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& workspace) const;

  /// The same with memory of its own for this call.
  void solve(const double* b, double* x) const;
  void solve(std::span<const double* const> b, std::span<double* const> x) const;

  const std::shared_ptr<const CholeskyAnalysis>& analysis() const { return analysis_; }

  /// What it is in: not always what was asked for.
  Precision precision() const;

  /// Memory of the factor, without that of the analysis.
  std::size_t bytes() const;

 private:
  std::shared_ptr<const CholeskyAnalysis> analysis_;
  std::unique_ptr<FactorBackend> backend_;
  Verdict verdict_ = Verdict::kUnclear;
};

}  // namespace diffcloth::linalg
