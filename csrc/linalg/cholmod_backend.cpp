#ifdef DIFFCLOTH_HAS_CHOLMOD

#include <algorithm>
#include <cmath>
#include <mutex>
#include <stdexcept>

#include <cholmod.h>

#include "linalg/backend.h"
#include "linalg/scalar_matrix.h"

// Threads inside one small factorization cost more than they gain (most of the time was spent waiting),
// and would make results depend on their number. The symbols exist only if CHOLMOD is linked to
// OpenBLAS, and to an OpenMP runtime.
extern "C" void openblas_set_num_threads(int) __attribute__((weak));
extern "C" int omp_get_max_active_levels() __attribute__((weak));
extern "C" void omp_set_max_active_levels(int) __attribute__((weak));

namespace diffcloth::linalg {
namespace {

/// Lock for all calls that may reach the BLAS: an OpenBLAS built for one thread, as distributions ship
/// it, has no locks, and concurrent calls from two threads corrupt each other.
std::mutex& blas_mutex() {
  static std::mutex mutex;
  return mutex;
}

/// Scope in which OpenMP regions of this thread run serially. CHOLMOD sets a number of threads in its
/// regions, so that only this limit is effective.
class SerialOpenMp {
 public:
  SerialOpenMp() {
    if (available()) omp_set_max_active_levels(0);
  }
  ~SerialOpenMp() {
    if (available()) omp_set_max_active_levels(levels());
  }
  SerialOpenMp(const SerialOpenMp&) = delete;
  SerialOpenMp& operator=(const SerialOpenMp&) = delete;

 private:
  static bool available() {
    return omp_get_max_active_levels != nullptr && omp_set_max_active_levels != nullptr &&
           levels() >= 0;
  }
  // Read once, before the first change: some OpenMP libraries share this limit among threads.
  static int levels() {
    static const int before = omp_get_max_active_levels();
    return before;
  }
};

/// One cholmod_common with our settings; freed with its owner.
struct Common {
  cholmod_common c;

  Common() {
    if (openblas_set_num_threads != nullptr) openblas_set_num_threads(1);
    cholmod_start(&c);
    c.supernodal = CHOLMOD_SUPERNODAL;
    c.final_ll = 1;
    c.nmethods = 1;
    c.method[0].ordering = CHOLMOD_NATURAL;  // the matrix arrives permuted, in postorder
    c.postorder = 0;
    c.print = 0;
    c.error_handler = nullptr;
    c.try_catch = 1;
  }
  ~Common() { cholmod_finish(&c); }
  Common(const Common&) = delete;
  Common& operator=(const Common&) = delete;
};

/// View of the matrix for CHOLMOD, without copying.
cholmod_sparse view(const ScalarMatrix& matrix, const double* values) {
  cholmod_sparse m{};
  m.nrow = m.ncol = static_cast<std::size_t>(matrix.dimension());
  m.nzmax = matrix.row.size();
  m.p = const_cast<Index*>(matrix.column_start.data());
  m.i = const_cast<Index*>(matrix.row.data());
  m.x = const_cast<double*>(values);
  m.stype = -1;
  m.itype = CHOLMOD_INT;
  m.xtype = values != nullptr ? CHOLMOD_REAL : CHOLMOD_PATTERN;
  m.dtype = CHOLMOD_DOUBLE;
  m.sorted = 1;
  m.packed = 1;
  return m;
}

std::size_t factor_bytes(const cholmod_factor& factor) {
  // Values, rows of the supernodes, and arrays over columns and supernodes.
  return sizeof(double) * (factor.x != nullptr ? factor.xsize : 0) +
         sizeof(int) * (factor.ssize + 3 * (factor.nsuper + 1) + 2 * factor.n);
}

/// Call visit(columns, rows) for each supernode of the symbolic factorization, in scalars.
template <class Visit>
void for_each_supernode(const cholmod_factor& factor, Visit visit) {
  const auto* const super = static_cast<const int*>(factor.super);
  const auto* const start = static_cast<const int*>(factor.pi);
  for (std::size_t s = 0; s < factor.nsuper; ++s) {
    visit(super[s + 1] - super[s], start[s + 1] - start[s]);
  }
}

double trace(const cholmod_factor& factor) {
  const auto* const start = static_cast<const int*>(factor.px);
  const auto* const values = static_cast<const double*>(factor.x);
  double sum = 0.0;
  std::size_t s = 0;
  for_each_supernode(factor, [&](int columns, int rows) {
    const double* const panel = values + start[s++];
    for (std::ptrdiff_t j = 0; j < columns; ++j) sum += panel[j + j * rows];
  });
  return sum;
}

/// Symbolic factorization with its matrix.
struct Structure {
  ScalarMatrix matrix;
  mutable std::mutex mutex;  // guards `common` while factors are copied
  mutable Common common;
  cholmod_factor* symbolic = nullptr;

  explicit Structure(const Elimination& elimination) : matrix(elimination) {
    if (matrix.dimension() == 0) return;
    const SerialOpenMp serial;
    cholmod_sparse sparse = view(matrix, nullptr);
    symbolic = cholmod_analyze(&sparse, &common.c);
    if (symbolic == nullptr) throw std::runtime_error("CHOLMOD: analysis failed");
  }
  ~Structure() {
    if (symbolic != nullptr) cholmod_free_factor(&symbolic, &common.c);
  }
  Structure(const Structure&) = delete;
  Structure& operator=(const Structure&) = delete;
};

class CholmodFactor final : public FactorBackend {
 public:
  explicit CholmodFactor(const Structure& structure) : structure_(structure) {
    if (structure.symbolic == nullptr) return;
    const std::lock_guard lock(structure.mutex);
    factor_ = cholmod_copy_factor(structure.symbolic, &common_.c);
    if (factor_ == nullptr) throw std::runtime_error("CHOLMOD: out of memory");
  }
  ~CholmodFactor() override {
    cholmod_free_dense(&x_, &common_.c);
    cholmod_free_dense(&y_, &common_.c);
    cholmod_free_dense(&e_, &common_.c);
    if (factor_ != nullptr) cholmod_free_factor(&factor_, &common_.c);
  }

  Verdict compute(const double* blocks,
                  CholeskyWorkspace& /*workspace*/,
                  CholeskySeconds* /*seconds*/) override {
    if (factor_ == nullptr) return Verdict::kPositive;
    structure_.matrix.gather(blocks, values_);
    const std::lock_guard lock(blas_mutex());
    const SerialOpenMp serial;
    cholmod_sparse matrix = view(structure_.matrix, values_.data());
    cholmod_factorize(&matrix, factor_, &common_.c);
    if (common_.c.status < CHOLMOD_OK) throw std::runtime_error("CHOLMOD: factorization failed");
    // A BLAS may accept NaN as a pivot; it then appears on the diagonal.
    const bool positive = common_.c.status == CHOLMOD_OK && factor_->minor == factor_->n &&
                          std::isfinite(trace(*factor_));
    return positive ? Verdict::kPositive : Verdict::kIndefinite;
  }

  void solve(std::span<const double* const> b,
             std::span<double* const> x,
             CholeskyWorkspace& /*workspace*/) const override {
    if (factor_ == nullptr) return;
    const std::vector<Index>& unknown = structure_.matrix.unknown;
    std::vector<double> permuted(unknown.size());
    const std::lock_guard lock(blas_mutex());
    for (std::size_t r = 0; r < b.size(); ++r) {
      for (std::size_t k = 0; k < unknown.size(); ++k) permuted[k] = b[r][unknown[k]];
      const double* const solution = solve_permuted(permuted);
      for (std::size_t k = 0; k < unknown.size(); ++k) x[r][unknown[k]] = solution[k];
    }
  }

  std::size_t bytes() const override {
    return sizeof(*this) + values_.capacity() * sizeof(double) +
           (factor_ != nullptr ? factor_bytes(*factor_) : 0) + dense_bytes();
  }

 private:
  const double* solve_permuted(std::vector<double>& b) const {
    cholmod_dense rhs{};
    rhs.nrow = rhs.nzmax = rhs.d = b.size();
    rhs.ncol = 1;
    rhs.x = b.data();
    rhs.xtype = CHOLMOD_REAL;
    rhs.dtype = CHOLMOD_DOUBLE;
    const SerialOpenMp serial;
    if (!cholmod_solve2(CHOLMOD_A, factor_, &rhs, nullptr, &x_, nullptr, &y_, &e_, &common_.c)) {
      throw std::runtime_error("CHOLMOD: solve failed");
    }
    return static_cast<const double*>(x_->x);
  }

  /// The solver's vectors: at most three of the factor's height.
  std::size_t dense_bytes() const {
    return 3 * sizeof(double) * (factor_ != nullptr ? factor_->n : 0);
  }

  const Structure& structure_;
  mutable Common common_;
  cholmod_factor* factor_ = nullptr;
  std::vector<double> values_;
  mutable cholmod_dense* x_ = nullptr;
  mutable cholmod_dense* y_ = nullptr;
  mutable cholmod_dense* e_ = nullptr;
};

class CholmodAnalysis final : public AnalysisBackend {
 public:
  explicit CholmodAnalysis(const Elimination& elimination) : structure_(elimination) {
    if (structure_.symbolic == nullptr) return;
    for_each_supernode(*structure_.symbolic, [&](int columns, int rows) {
      for (int j = 0; j < columns; ++j) {
        const double height = rows - j;
        nonzeros_ += static_cast<std::size_t>(rows - j);
        flops_ += height * height;
      }
    });
  }

  std::unique_ptr<FactorBackend> make_factor(
      Precision /*precision*/, const std::shared_ptr<SpareRoom>& /*room*/) const override {
    return std::make_unique<CholmodFactor>(structure_);
  }
  Index dimension() const override { return structure_.matrix.dimension(); }
  std::size_t nonzeros() const override { return nonzeros_; }
  double flops() const override { return flops_; }
  std::size_t bytes() const override {
    return sizeof(*this) + structure_.matrix.bytes() +
           (structure_.symbolic != nullptr ? factor_bytes(*structure_.symbolic) : 0);
  }

 private:
  Structure structure_;
  std::size_t nonzeros_ = 0;
  double flops_ = 0.0;
};

}  // namespace

std::unique_ptr<const AnalysisBackend> analyze_cholmod(const Elimination& elimination) {
  return std::make_unique<CholmodAnalysis>(elimination);
}

}  // namespace diffcloth::linalg

#endif
