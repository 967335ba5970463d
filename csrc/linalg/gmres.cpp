#include "linalg/gmres.h"

#include <cmath>
#include <cstddef>

#include <Eigen/Core>
#include <Eigen/Jacobi>

namespace diffcloth::linalg {
namespace {

/// Number of basis vectors before a restart; bounds memory and the cost of orthogonalization.
constexpr int kBasis = 60;

using Map = Eigen::Map<Eigen::VectorXd>;
Map view(std::vector<double>& v) { return {v.data(), static_cast<Eigen::Index>(v.size())}; }

}  // namespace

GmresOutcome gmres(const LinearMap& apply,
                   const LinearMap& precondition,
                   const std::vector<double>& b,
                   double tolerance,
                   int max_iterations,
                   std::vector<double>& x) {
  const std::size_t n = b.size();
  std::vector<double> product(n);
  std::vector<double> w(n);
  x.assign(n, 0.0);
  precondition(b, w);
  const double goal = tolerance * view(w).norm();
  int iterations = 0;
  std::vector<std::vector<double>> basis;
  while (true) {
    // w is the preconditioned residual of x.
    double residual = view(w).norm();
    if (residual <= goal) return {.converged = true, .iterations = iterations};
    if (!std::isfinite(residual) || iterations >= max_iterations) {
      return {.converged = false, .iterations = iterations};
    }
    Eigen::MatrixXd R = Eigen::MatrixXd::Zero(kBasis + 1, kBasis);
    Eigen::VectorXd rhs = Eigen::VectorXd::Zero(kBasis + 1);
    std::vector<Eigen::JacobiRotation<double>> turns;
    rhs[0] = residual;
    view(w) /= residual;
    basis.assign(1, w);
    int k = 0;
    while (k < kBasis && iterations < max_iterations && residual > goal) {
      apply(basis[k], product);
      precondition(product, w);
      for (int i = 0; i <= k; ++i) {
        R(i, k) = view(basis[i]).dot(view(w));
        view(w) -= R(i, k) * view(basis[i]);
      }
      const double next = view(w).norm();
      R(k + 1, k) = next;
      for (int i = 0; i < k; ++i) R.col(k).applyOnTheLeft(i, i + 1, turns[i].adjoint());
      Eigen::JacobiRotation<double> turn;
      turn.makeGivens(R(k, k), R(k + 1, k));
      R.col(k).applyOnTheLeft(k, k + 1, turn.adjoint());
      rhs.applyOnTheLeft(k, k + 1, turn.adjoint());
      turns.push_back(turn);
      residual = std::abs(rhs[k + 1]);
      ++k;
      ++iterations;
      if (!(next > 0.0)) break;
      view(w) /= next;
      basis.push_back(w);
    }
    const Eigen::VectorXd y =
        R.topLeftCorner(k, k).triangularView<Eigen::Upper>().solve(rhs.head(k));
    for (int i = 0; i < k; ++i) view(x) += y[i] * view(basis[i]);
    if (residual <= goal) return {.converged = true, .iterations = iterations};
    apply(x, product);
    for (std::size_t a = 0; a < n; ++a) product[a] = b[a] - product[a];
    precondition(product, w);
  }
}

}  // namespace diffcloth::linalg
