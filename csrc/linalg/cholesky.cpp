#include "linalg/cholesky.h"

#include <algorithm>
#include <stdexcept>
#include <string_view>

#include "linalg/backend.h"
#include "linalg/elimination_tree.h"
#include "linalg/graph.h"
#include "linalg/ordering.h"

namespace diffcloth::linalg {
namespace {

std::unique_ptr<const AnalysisBackend> analyze(const BlockPattern& pattern,
                                               const std::vector<char>& fixed,
                                               Backend backend,
                                               const CholeskyOptions& options) {
  Graph graph = unknown_graph(pattern, fixed);
  EliminationTree tree = eliminate(graph, fill_reducing_order(graph, options.ordering));
  Elimination elimination{.pattern = pattern, .graph = std::move(graph), .tree = std::move(tree)};
  switch (backend) {
    case Backend::kMultifrontal:
      return analyze_multifrontal(std::move(elimination), options.level);
    case Backend::kEigen:
      return analyze_eigen(elimination);
    case Backend::kCholmod:
#ifdef DIFFCLOTH_HAS_CHOLMOD
      return analyze_cholmod(elimination);
#else
      throw std::invalid_argument("this build has no CHOLMOD");
#endif
  }
  throw std::invalid_argument("unknown factorization backend");
}

}  // namespace

const char* name(Backend backend) {
  switch (backend) {
    case Backend::kMultifrontal:
      return "multifrontal";
    case Backend::kEigen:
      return "eigen";
    case Backend::kCholmod:
      return "cholmod";
  }
  throw std::invalid_argument("unknown factorization backend");
}

const std::vector<Backend>& available_backends() {
  static const std::vector<Backend> backends = {
      Backend::kMultifrontal,
      Backend::kEigen,
#ifdef DIFFCLOTH_HAS_CHOLMOD
      Backend::kCholmod,
#endif
  };
  return backends;
}

Backend default_backend() {
  static const Backend backend =
      *std::ranges::find(available_backends(), std::string_view(DIFFCLOTH_FACTORIZATION),
                         [](Backend b) { return std::string_view(name(b)); });
  return backend;
}

std::string factorization_name() {
  const std::string own = name(default_backend());
  return default_backend() == Backend::kMultifrontal ? own + " (" + name(chosen_level()) + ")"
                                                     : own;
}

void* CholeskyWorkspace::reserve_bytes(std::size_t size) {
  if (buffer_.size() < size) {
    buffer_ = {};  // free the old buffer first, to limit the peak
    buffer_ = AlignedBuffer<std::byte>(size);
  }
  return buffer_.data();
}

CholeskyAnalysis::CholeskyAnalysis(const BlockPattern& pattern,
                                   const std::vector<char>& fixed,
                                   Backend backend,
                                   const CholeskyOptions& options)
    : backend_(analyze(pattern, fixed, backend, options)) {}

CholeskyAnalysis::~CholeskyAnalysis() = default;

Index CholeskyAnalysis::dimension() const { return backend_->dimension(); }
std::size_t CholeskyAnalysis::bytes() const { return sizeof(*this) + backend_->bytes(); }
std::size_t CholeskyAnalysis::nonzeros() const { return backend_->nonzeros(); }
double CholeskyAnalysis::flops() const { return backend_->flops(); }

CholeskyFactor::CholeskyFactor(std::shared_ptr<const CholeskyAnalysis> analysis,
                               Precision precision,
                               const std::shared_ptr<SpareRoom>& room)
    : analysis_(std::move(analysis)), backend_(analysis_->backend().make_factor(precision, room)) {}

CholeskyFactor::~CholeskyFactor() = default;

Verdict CholeskyFactor::compute(const double* blocks,
                                CholeskyWorkspace& workspace,
                                CholeskySeconds* seconds) {
  verdict_ = Verdict::kUnclear;  // also if it throws
  verdict_ = backend_->compute(blocks, workspace, seconds);
  return verdict_;
}

Verdict CholeskyFactor::compute(const double* blocks) {
  CholeskyWorkspace workspace;
  return compute(blocks, workspace);
}

void CholeskyFactor::solve(const double* b, double* x, CholeskyWorkspace& workspace) const {
  solve(std::span(&b, 1), std::span(&x, 1), workspace);
}

void CholeskyFactor::solve(std::span<const double* const> b,
                           std::span<double* const> x,
                           CholeskyWorkspace& workspace) const {
  if (verdict_ != Verdict::kPositive)
    throw std::logic_error("solve: the matrix has not been factored");
  if (b.size() != x.size()) throw std::invalid_argument("solve: as many solutions as right sides");
  backend_->solve(b, x, workspace);
}

void CholeskyFactor::solve(const double* b, double* x) const {
  solve(std::span(&b, 1), std::span(&x, 1));
}

void CholeskyFactor::solve(std::span<const double* const> b, std::span<double* const> x) const {
  CholeskyWorkspace workspace;
  solve(b, x, workspace);
}

Precision CholeskyFactor::precision() const { return backend_->precision(); }
std::size_t CholeskyFactor::bytes() const { return sizeof(*this) + backend_->bytes(); }

}  // namespace diffcloth::linalg
