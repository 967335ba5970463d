#include "solver/linear_system.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

#include "common/fixed_noise.h"
#include "solver/stopping.h"

namespace diffcloth::solver {
namespace {

/// A fixed right side without symmetry, with entries of the size of the square root of the diagonal.
std::vector<double> probe(const linalg::BlockValues& matrix) {
  const linalg::BlockPattern& pattern = matrix.pattern();
  std::vector<double> b(3 * static_cast<std::size_t>(pattern.size()));
  FixedNoise noise;
  for (std::size_t a = 0; a < b.size(); ++a) {
    const auto slot = static_cast<std::size_t>(pattern.column_start()[a / 3]);
    b[a] = noise() * std::sqrt(std::abs(matrix.blocks()[9 * slot + 4 * (a % 3)]));
  }
  return b;
}

}  // namespace

std::size_t Certificate::bytes() const {
  return (factor ? factor->bytes() : 0) + (hessian ? hessian->bytes() : 0);
}

linalg::BlockMatrix LinearSystem::assemble(const double* x,
                                           Curvature curvature,
                                           const std::vector<double>& g) {
  const Stopwatch::Scope scope(watch_, Phase::kAssembly);
  const std::size_t size = 3 * static_cast<std::size_t>(f_.coordinates->point_count());
  if (pattern_ == nullptr || !std::equal(x_.begin(), x_.end(), x)) {
    pattern_ = f_.pattern();
    x_.assign(x, x + size);
  }
  linalg::BlockMatrix matrix({pattern_, &pattern_->merged}, f_.patterns->fixed(),
                             &f_.coordinates->attachments());
  f_.for_each([&](const Potential& p) { p.add_hessian(x, curvature, matrix); });
  // The positive Hessian omits the curvature of the paths of points, whose sign is arbitrary.
  if (curvature != Curvature::kPositive) f_.coordinates->add_curvature(x, g, matrix);
  return matrix;
}

linalg::BlockMatrix LinearSystem::assemble_extrapolated(const double* x,
                                                        Curvature curvature,
                                                        const std::vector<double>& g) {
  linalg::BlockMatrix matrix = assemble(x, curvature, g);
  const Stopwatch::Scope scope(watch_, Phase::kAssembly);
  f_.for_each([&](const Potential& p) { p.add_extrapolation(x, curvature, matrix); });
  return matrix;
}

Factor LinearSystem::factor(const linalg::BlockValues& matrix,
                            linalg::Precision precision,
                            linalg::Verdict& verdict) {
  std::shared_ptr<linalg::CholeskyFactor> factor;
  {
    const Stopwatch::Scope scope(watch_, Phase::kAnalysis);
    const AnalyzedPattern::Found found = pattern_->analysis();
    counts_.analyses += found.is_new ? 1 : 0;
    factor = std::make_shared<linalg::CholeskyFactor>(found.analysis, precision, workspace_.room());
  }
  const Stopwatch::Scope scope(watch_, Phase::kFactorization);
  ++counts_.factorizations;
  counts_.in_doubles += factor->precision() == linalg::Precision::kDouble ? 1 : 0;
  verdict = factor->compute(matrix.blocks(), workspace_);
  return verdict == linalg::Verdict::kPositive ? factor : nullptr;
}

Certificate LinearSystem::certify(const double* x,
                                  const std::vector<double>& g,
                                  std::vector<double>& p) {
  linalg::BlockMatrix matrix = assemble(x, Curvature::kExact, g);
  Certificate result;
  result.factor = factor(matrix);
  if (!result.factor) return result;
  solve(*result.factor, g, p);
  if (result.factor->precision() == linalg::Precision::kDouble) return result;
  result.hessian = std::make_shared<const linalg::BlockValues>(std::move(matrix));
  confirm(result, g, p);
  return result;
}

void LinearSystem::confirm(Certificate& certificate,
                           const std::vector<double>& g,
                           std::vector<double>& p) {
  if (agrees(certificate, g, p)) return;
  certificate.factor = nullptr;  // never two at once
  certificate.factor = factor_in_doubles(*certificate.hessian);
  certificate.hessian = nullptr;
  if (certificate.factor) solve(*certificate.factor, g, p);
}

bool LinearSystem::agrees(const Certificate& certificate,
                          const std::vector<double>& g,
                          const std::vector<double>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  std::vector<double> b = probe(*certificate.hessian);
  std::vector<double> z(b.size(), 0.0);
  certificate.factor->solve(b.data(), z.data(), workspace_);
  // Add the gradient with the same weight, and the step that the factor yields for it.
  f_.coordinates->pull_back(g, b_);
  f_.coordinates->take_rows(p, z_);
  const double own = -linalg::dot(z_, b_);
  const double weight = own > 0.0 ? std::sqrt(linalg::dot(z, b) / own) : 0.0;
  for (std::size_t a = 0; a < b.size(); ++a) {
    b[a] += weight * b_[a];
    z[a] -= weight * z_[a];
  }
  return linalg::agrees(*certificate.hessian, *certificate.factor, b, z, stopping::kAgreement,
                        workspace_);
}

void LinearSystem::solve(const linalg::CholeskyFactor& factor,
                         const std::vector<double>& b,
                         std::vector<double>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  f_.coordinates->pull_back(b, b_);
  z_.assign(b_.size(), 0.0);
  factor.solve(b_.data(), z_.data(), workspace_);
  for (double& value : z_) value = -value;
  f_.coordinates->push_forward(z_, p);
}

void LinearSystem::refine(const linalg::CholeskyFactor& factor,
                          const linalg::BlockValues& matrix,
                          const std::vector<double>& b,
                          std::vector<double>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  f_.coordinates->pull_back(b, b_);
  f_.coordinates->take_rows(p, z_);
  matrix.add_product(z_.data(), b_.data());  // b + A p: the residual
  std::vector<double> change(z_.size(), 0.0);
  factor.solve(b_.data(), change.data(), workspace_);
  for (std::size_t a = 0; a < z_.size(); ++a) z_[a] -= change[a];
  f_.coordinates->push_forward(z_, p);
}

void LinearSystem::solve(const Certificate& certificate,
                         const std::vector<std::vector<double>>& b,
                         std::vector<std::vector<double>>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  std::vector<std::vector<double>> right(b.size());
  std::vector<std::vector<double>> z(b.size());
  for (std::size_t r = 0; r < b.size(); ++r) {
    f_.coordinates->pull_back(b[r], right[r]);
    z[r].assign(right[r].size(), 0.0);
  }
  const linalg::CholeskyFactor& factor = *certificate.factor;
  if (factor.precision() == linalg::Precision::kDouble) {
    linalg::solve(factor, right, workspace_, z);
  } else {
    const std::vector<char> converged = linalg::conjugate_gradients(
        *certificate.hessian, factor, right, stopping::kRefinement.residual,
        stopping::kRefinement.iterations, workspace_, z);
    if (std::ranges::count(converged, 0) > 0) {
      linalg::CholeskyFactor exact(factor.analysis());
      if (exact.compute(certificate.hessian->blocks(), workspace_) != linalg::Verdict::kPositive) {
        throw std::domain_error("the Hessian is not positive definite at the solution");
      }
      for (std::size_t r = 0; r < b.size(); ++r) {
        if (converged[r] != 0) continue;
        std::ranges::fill(z[r], 0.0);
        exact.solve(right[r].data(), z[r].data(), workspace_);
      }
    }
  }
  p.resize(b.size());
  for (std::size_t r = 0; r < b.size(); ++r) {
    for (double& value : z[r]) value = -value;
    f_.coordinates->push_forward(z[r], p[r]);
  }
}

linalg::Convergence LinearSystem::solve(const linalg::BlockValues& matrix,
                                        const linalg::CholeskyFactor& nearby,
                                        const std::vector<double>& b,
                                        double tolerance,
                                        int max_iterations,
                                        std::vector<double>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  f_.coordinates->pull_back(b, b_);
  f_.coordinates->take_rows(p, z_);
  for (double& value : z_) value = -value;
  const linalg::Convergence result =
      linalg::conjugate_gradient(matrix, nearby, b_, tolerance, max_iterations,
                                 stopping::kConjugateGradients.fastest, workspace_, z_);
  for (double& value : z_) value = -value;
  f_.coordinates->push_forward(z_, p);
  return result;
}

}  // namespace diffcloth::solver
