#include "linalg/cholesky.h"

#include <algorithm>
#include <mutex>
#include <stdexcept>
#include <string>

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>

#ifdef DIFFCLOTH_HAS_CHOLMOD
#include <cholmod.h>

// Threads inside one small factorization cost more than they bring (most of the time went into
// waiting for them), and would make results depend on their number. Present only where CHOLMOD is
// linked to OpenBLAS, and to an OpenMP runtime.
extern "C" void openblas_set_num_threads(int) __attribute__((weak));
extern "C" int omp_get_max_active_levels() __attribute__((weak));
extern "C" void omp_set_max_active_levels(int) __attribute__((weak));
#endif

namespace diffcloth::linalg {
namespace {

/// Elimination order of the vertices that are not fixed: order[k] is the k-th vertex.
std::vector<Index> minimum_degree_order(const BlockPattern& pattern,
                                        const std::vector<char>& fixed) {
  std::vector<Index> compact(pattern.size(), -1);
  std::vector<Index> vertex;
  for (Index i = 0; i < pattern.size(); ++i) {
    if (fixed[i]) continue;
    compact[i] = static_cast<Index>(vertex.size());
    vertex.push_back(i);
  }
  std::vector<Eigen::Triplet<double>> entries;
  entries.reserve(static_cast<std::size_t>(pattern.block_count()));
  for (Index j = 0; j < pattern.size(); ++j) {
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (compact[i] >= 0 && compact[j] >= 0) entries.emplace_back(compact[i], compact[j], 1.0);
    }
  }
  const auto n = static_cast<Eigen::Index>(vertex.size());
  Eigen::SparseMatrix<double> graph(n, n);
  graph.setFromTriplets(entries.begin(), entries.end());
  Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, int> permutation;
  Eigen::AMDOrdering<int>()(graph.selfadjointView<Eigen::Lower>(), permutation);

  std::vector<Index> order(vertex.size());
  for (std::size_t k = 0; k < order.size(); ++k) {
    order[k] = vertex[permutation.indices()[static_cast<Eigen::Index>(k)]];
  }
  return order;
}

}  // namespace

#ifdef DIFFCLOTH_HAS_CHOLMOD

namespace {

/// While it lives, OpenMP regions of this thread run on it alone. CHOLMOD names a number of threads
/// in its own, so that only this limit binds it.
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
  // Read once, before the first change: some OpenMP libraries share the limit between threads.
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
    c.method[0].ordering = CHOLMOD_NATURAL;  // the matrix arrives permuted
    c.postorder = 1;
    c.print = 0;
    c.error_handler = nullptr;
    c.try_catch = 1;
  }
  ~Common() { cholmod_finish(&c); }
  Common(const Common&) = delete;
  Common& operator=(const Common&) = delete;
};

/// The analysis' matrix as CHOLMOD sees it, without copying.
cholmod_sparse view(const CholeskyAnalysis& a, const double* values) {
  cholmod_sparse m{};
  m.nrow = m.ncol = static_cast<std::size_t>(a.dimension());
  m.nzmax = a.row.size();
  m.p = const_cast<Index*>(a.column_start.data());
  m.i = const_cast<Index*>(a.row.data());
  m.x = const_cast<double*>(values);
  m.stype = -1;
  m.itype = CHOLMOD_INT;
  m.xtype = values != nullptr ? CHOLMOD_REAL : CHOLMOD_PATTERN;
  m.dtype = CHOLMOD_DOUBLE;
  m.sorted = 1;
  m.packed = 1;
  return m;
}

}  // namespace

struct CholeskyAnalysis::Backend {
  mutable std::mutex mutex;
  mutable Common common;
  cholmod_factor* symbolic = nullptr;

  Backend(const CholeskyAnalysis& a, bool reorder) {
    const SerialOpenMp serial;
    common.c.postorder = reorder ? 1 : 0;
    cholmod_sparse matrix = view(a, nullptr);
    symbolic = cholmod_analyze(&matrix, &common.c);
    if (symbolic == nullptr) throw std::runtime_error("CHOLMOD: analysis failed");
  }

  /// The vertices in the order that CHOLMOD would rather have.
  std::vector<Index> vertex_order(const CholeskyAnalysis& a) const {
    const auto* order = static_cast<const Index*>(symbolic->Perm);
    std::vector<Index> result;
    for (Index k = 0; k < a.dimension(); ++k) {
      // The three coordinates of a vertex form a chain of the elimination tree: the first leads.
      if (order[k] % 3 == 0) result.push_back(a.unknown[order[k]] / 3);
    }
    return result;
  }

  ~Backend() { cholmod_free_factor(&symbolic, &common.c); }
  Backend(const Backend&) = delete;
  Backend& operator=(const Backend&) = delete;
};

struct CholeskyFactor::Backend {
  mutable std::mutex mutex;
  mutable Common common;
  cholmod_factor* factor = nullptr;
  mutable cholmod_dense* x = nullptr;
  mutable cholmod_dense* y = nullptr;
  mutable cholmod_dense* e = nullptr;

  explicit Backend(const CholeskyAnalysis& a) {
    const std::lock_guard lock(a.backend->mutex);
    factor = cholmod_copy_factor(a.backend->symbolic, &common.c);
    if (factor == nullptr) throw std::runtime_error("CHOLMOD: out of memory");
  }
  ~Backend() {
    cholmod_free_dense(&x, &common.c);
    cholmod_free_dense(&y, &common.c);
    cholmod_free_dense(&e, &common.c);
    cholmod_free_factor(&factor, &common.c);
  }
  Backend(const Backend&) = delete;
  Backend& operator=(const Backend&) = delete;

  bool compute(const CholeskyAnalysis& a, const double* values) {
    const SerialOpenMp serial;
    cholmod_sparse matrix = view(a, values);
    cholmod_factorize(&matrix, factor, &common.c);
    if (common.c.status < CHOLMOD_OK) throw std::runtime_error("CHOLMOD: factorization failed");
    return common.c.status == CHOLMOD_OK && factor->minor == factor->n;
  }

  void solve(std::vector<double>& b) const {
    cholmod_dense rhs{};
    rhs.nrow = rhs.nzmax = rhs.d = b.size();
    rhs.ncol = 1;
    rhs.x = b.data();
    rhs.xtype = CHOLMOD_REAL;
    rhs.dtype = CHOLMOD_DOUBLE;
    const SerialOpenMp serial;
    if (!cholmod_solve2(CHOLMOD_A, factor, &rhs, nullptr, &x, nullptr, &y, &e, &common.c)) {
      throw std::runtime_error("CHOLMOD: solve failed");
    }
    const auto* solution = static_cast<const double*>(x->x);
    std::copy(solution, solution + b.size(), b.begin());
  }

  std::size_t bytes() const {
    return sizeof(double) * factor->xsize + sizeof(int) * (factor->ssize + 4 * factor->n);
  }
};

const char* factorization_name() {
  static const std::string name = "cholmod " + std::to_string(CHOLMOD_MAIN_VERSION) + "." +
                                  std::to_string(CHOLMOD_SUB_VERSION) + "." +
                                  std::to_string(CHOLMOD_SUBSUB_VERSION);
  return name.c_str();
}

#else

namespace {

using Sparse = Eigen::SparseMatrix<double, Eigen::ColMajor, Index>;
using EigenFactor = Eigen::SimplicialLLT<Sparse, Eigen::Lower, Eigen::NaturalOrdering<Index>>;

Eigen::Map<const Sparse> view(const CholeskyAnalysis& a, const double* values) {
  return {a.dimension(),         a.dimension(), static_cast<Index>(a.row.size()),
          a.column_start.data(), a.row.data(),  values};
}

}  // namespace

struct CholeskyAnalysis::Backend {
  Backend(const CholeskyAnalysis& /*analysis*/, bool /*reorder*/) {}
  static std::vector<Index> vertex_order(const CholeskyAnalysis& /*analysis*/) { return {}; }
};

struct CholeskyFactor::Backend {
  mutable std::mutex mutex;
  EigenFactor factor;

  explicit Backend(const CholeskyAnalysis& a) {
    const std::vector<double> ones(a.row.size(), 1.0);
    factor.analyzePattern(view(a, ones.data()));
  }
  bool compute(const CholeskyAnalysis& a, const double* values) {
    factor.factorize(view(a, values));
    return factor.info() == Eigen::Success;
  }
  void solve(std::vector<double>& b) const {
    Eigen::Map<Eigen::VectorXd> x(b.data(), static_cast<Eigen::Index>(b.size()));
    x = factor.solve(x).eval();
  }
  std::size_t bytes() const {
    return (sizeof(double) + sizeof(Index)) *
           static_cast<std::size_t>(factor.matrixL().nestedExpression().nonZeros());
  }
};

const char* factorization_name() { return "eigen"; }

#endif

CholeskyAnalysis::CholeskyAnalysis(const BlockPattern& pattern, const std::vector<char>& fixed) {
  permute(pattern, minimum_degree_order(pattern, fixed));
  if (dimension() == 0) return;
  // In postorder the factorization takes the matrix as it stands, without two transposes each time.
  const std::vector<Index> postorder = Backend(*this, true).vertex_order(*this);
  if (!postorder.empty()) permute(pattern, postorder);
  backend = std::make_unique<Backend>(*this, false);
}

void CholeskyAnalysis::permute(const BlockPattern& pattern, const std::vector<Index>& order) {
  unknown.clear();
  row.clear();
  source.clear();
  column_start.clear();
  std::vector<Index> rank(pattern.size(), -1);
  for (std::size_t k = 0; k < order.size(); ++k) rank[order[k]] = static_cast<Index>(k);
  for (const Index vertex : order) {
    for (Index axis = 0; axis < 3; ++axis) unknown.push_back(3 * vertex + axis);
  }

  // Blocks of the permuted lower triangle, column by column: row, slot, and whether the stored
  // block stands the other way round.
  struct Block {
    Index row, slot;
    bool transposed;
  };
  std::vector<std::vector<Block>> columns(order.size());
  for (Index j = 0; j < pattern.size(); ++j) {
    if (rank[j] < 0) continue;
    for (Index k = pattern.column_start()[j]; k < pattern.column_start()[j + 1]; ++k) {
      const Index i = pattern.row()[k];
      if (rank[i] < 0) continue;
      columns[std::min(rank[i], rank[j])].push_back(
          {.row = std::max(rank[i], rank[j]), .slot = k, .transposed = rank[i] < rank[j]});
    }
  }
  column_start.push_back(0);
  for (std::size_t j = 0; j < columns.size(); ++j) {
    std::ranges::sort(columns[j], {}, &Block::row);
    for (Index b = 0; b < 3; ++b) {
      for (const Block& block : columns[j]) {
        const Index first = block.row == static_cast<Index>(j) ? b : 0;
        for (Index a = first; a < 3; ++a) {
          row.push_back(3 * block.row + a);
          source.push_back(9 * block.slot + (block.transposed ? b + 3 * a : a + 3 * b));
        }
      }
      column_start.push_back(static_cast<Index>(row.size()));
    }
  }
}

CholeskyAnalysis::~CholeskyAnalysis() = default;

CholeskyFactor::CholeskyFactor(std::shared_ptr<const CholeskyAnalysis> analysis)
    : analysis_(std::move(analysis)),
      backend_(analysis_->dimension() > 0 ? std::make_unique<Backend>(*analysis_) : nullptr),
      values_(analysis_->row.size()) {}

CholeskyFactor::~CholeskyFactor() = default;

bool CholeskyFactor::compute(const double* blocks) {
  if (analysis_->dimension() == 0) return true;
  for (std::size_t k = 0; k < values_.size(); ++k) values_[k] = blocks[analysis_->source[k]];
  return backend_->compute(*analysis_, values_.data());
}

void CholeskyFactor::solve(const double* b, double* x) const {
  const std::vector<Index>& unknown = analysis_->unknown;
  if (unknown.empty()) return;
  const std::lock_guard lock(backend_->mutex);
  std::vector<double> permuted(unknown.size());
  for (std::size_t k = 0; k < unknown.size(); ++k) permuted[k] = b[unknown[k]];
  backend_->solve(permuted);
  for (std::size_t k = 0; k < unknown.size(); ++k) x[unknown[k]] = permuted[k];
}

std::size_t CholeskyFactor::bytes() const {
  return backend_ ? backend_->bytes() + sizeof(double) * values_.size() : 0;
}

}  // namespace diffcloth::linalg
