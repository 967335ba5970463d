#include "solver/linear_system.h"

#include <algorithm>

namespace diffcloth::solver {

linalg::BlockMatrix LinearSystem::assemble(const double* x,
                                           Curvature curvature,
                                           const std::vector<double>& g) {
  const Stopwatch::Scope scope(watch_, Phase::kAssembly);
  const std::size_t size = 3 * static_cast<std::size_t>(f_.coordinates->point_count());
  if (assembly_ == nullptr || !std::equal(x_.begin(), x_.end(), x)) {
    assembly_ = f_.assemblies->find(f_.couplings());
    x_.assign(x, x + size);
  }
  linalg::BlockMatrix matrix({assembly_, &assembly_->merged}, f_.assemblies->fixed(),
                             &f_.coordinates->attachments());
  f_.for_each([&](const Potential& p) { p.add_hessian(x, curvature, matrix); });
  // The positive one does without: what points do along their curves may be of any sign.
  if (curvature == Curvature::kExact) f_.coordinates->add_curvature(x, g, matrix);
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

Factor LinearSystem::factor(const linalg::BlockMatrix& matrix) {
  const Stopwatch::Scope analysis_scope(watch_, Phase::kAnalysis);
  const Assembly::Found found = assembly_->analysis();
  counts_.analyses += found.is_new ? 1 : 0;
  const Stopwatch::Scope scope(watch_, Phase::kFactorization);
  ++counts_.factorizations;
  auto factor = std::make_shared<linalg::CholeskyFactor>(found.analysis);
  if (!factor->compute(matrix.blocks(), workspace_)) return nullptr;
  return factor;
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

void LinearSystem::solve(const linalg::CholeskyFactor& factor,
                         const std::vector<std::vector<double>>& b,
                         std::vector<std::vector<double>>& p) {
  const Stopwatch::Scope scope(watch_, Phase::kSolve);
  std::vector<std::vector<double>> right(b.size());
  std::vector<std::vector<double>> z(b.size());
  std::vector<const double*> from;
  std::vector<double*> to;
  for (std::size_t r = 0; r < b.size(); ++r) {
    f_.coordinates->pull_back(b[r], right[r]);
    z[r].assign(right[r].size(), 0.0);
    from.push_back(right[r].data());
    to.push_back(z[r].data());
  }
  factor.solve(from, to, workspace_);
  p.resize(b.size());
  for (std::size_t r = 0; r < b.size(); ++r) {
    for (double& value : z[r]) value = -value;
    f_.coordinates->push_forward(z[r], p[r]);
  }
}

linalg::Convergence LinearSystem::solve(const linalg::BlockMatrix& matrix,
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
      linalg::conjugate_gradient(matrix.pattern(), matrix.blocks(), f_.assemblies->fixed(), nearby,
                                 b_, tolerance, max_iterations, workspace_, z_);
  for (double& value : z_) value = -value;
  f_.coordinates->push_forward(z_, p);
  return result;
}

}  // namespace diffcloth::solver
