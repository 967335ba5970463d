#include "linalg/conjugate_gradient.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "common/leading_power.h"

namespace diffcloth::linalg {
namespace {

/// Residuals seldom shrink more in an iteration: solves in which they would have to are given up.
constexpr double kFastest = 2.5;

/// See agrees().
constexpr double kFirstContraction = 0.1;
constexpr double kAgreement = 1e-4;
constexpr int kFewIterations = 6;

/// The way of one right side.
struct Descent {
  /// @param b      [size or more]
  /// @param first  [size] what the preconditioner makes of b
  Descent(const std::vector<double>& b, const std::vector<double>& first)
      : x(first.size(), 0.0),
        r(b.begin(), b.begin() + static_cast<std::ptrdiff_t>(first.size())),
        z(first),
        p(first),
        q(first.size()),
        rz(dot(r, z)) {}

  /// Go to the minimum along p. False where its curvature is not positive.
  bool advance(const BlockValues& A) {
    std::ranges::fill(q, 0.0);
    A.add_product(p.data(), q.data());
    return go();
  }

  /// The same, when q is what the matrix makes of p.
  bool go() {
    const double curvature = dot(p, q);
    if (!(curvature > 0.0)) return false;
    const double alpha = rz / curvature;
    for (std::size_t k = 0; k < x.size(); ++k) {
      x[k] += alpha * p[k];
      r[k] -= alpha * q[k];
    }
    return true;
  }

  /// Turn to the next direction, when z is what the preconditioner makes of r.
  void turn() {
    const double next = dot(r, z);
    const double beta = next / rz;
    last = rz;
    rz = next;
    for (std::size_t k = 0; k < p.size(); ++k) p[k] = z[k] + beta * p[k];
  }

  /// Residual, squared, to which the next iteration should lead: it shrinks as in the last one.
  double expected() const { return rz * rz / last; }

  std::vector<double> x, r, z, p, q;
  double rz;
  double last = rz;  ///< rz before the last iteration
};

}  // namespace

Convergence conjugate_gradient(const BlockValues& A,
                               const CholeskyFactor& preconditioner,
                               const std::vector<double>& b,
                               double tolerance,
                               int max_iterations,
                               CholeskyWorkspace& workspace,
                               std::vector<double>& x) {
  Descent descent(b, x);
  const double goal = tolerance * tolerance * descent.rz;
  Convergence result = Convergence::kIterationLimit;
  if (descent.rz == 0.0) result = Convergence::kConverged;
  for (int left = max_iterations; left > 0 && result == Convergence::kIterationLimit; --left) {
    if (!descent.advance(A)) {
      result = Convergence::kNegativeCurvature;
      break;
    }
    preconditioner.solve(descent.r.data(), descent.z.data(), workspace);
    descent.turn();
    if (descent.rz <= goal) result = Convergence::kConverged;
    if (descent.rz > goal * std::pow(kFastest * kFastest, left - 1)) break;
  }
  x = std::move(descent.x);
  return result;
}

void solve(const CholeskyFactor& factor,
           const std::vector<std::vector<double>>& b,
           CholeskyWorkspace& workspace,
           std::vector<std::vector<double>>& x) {
  std::vector<const double*> from;
  std::vector<double*> to;
  for (std::size_t k = 0; k < b.size(); ++k) {
    from.push_back(b[k].data());
    to.push_back(x[k].data());
  }
  factor.solve(from, to, workspace);
}

bool agrees(const BlockValues& A,
            const CholeskyFactor& factor,
            const std::vector<double>& b,
            const std::vector<double>& x,
            CholeskyWorkspace& workspace) {
  Descent descent(b, x);
  const double first = kFirstContraction * kFirstContraction * descent.rz;
  const double goal = kAgreement * kAgreement * descent.rz;
  for (int iteration = 0; iteration < kFewIterations; ++iteration) {
    if (!descent.advance(A)) return false;
    factor.solve(descent.r.data(), descent.z.data(), workspace);
    descent.turn();
    if (descent.rz <= goal) return true;
    if (!(descent.rz <= first)) return false;
  }
  return false;
}

std::vector<char> conjugate_gradients(const BlockValues& A,
                                      const CholeskyFactor& factor,
                                      const std::vector<std::vector<double>>& b,
                                      double tolerance,
                                      int max_iterations,
                                      CholeskyWorkspace& workspace,
                                      std::vector<std::vector<double>>& x) {
  // Products of residuals have twice the range of exponents.
  std::vector<double> units;
  std::vector<std::vector<double>> right = b;
  for (std::vector<double>& values : right) {
    double largest = 0.0;
    for (const double value : values) largest = std::max(largest, std::abs(value));
    units.push_back(leading_power(largest));
    for (double& value : values) value /= units.back();
  }
  solve(factor, right, workspace, x);
  std::vector<Descent> descents;
  std::vector<char> converged(b.size(), 1);
  std::vector<std::size_t> left;
  std::vector<double> goals;
  for (std::size_t k = 0; k < b.size(); ++k) {
    descents.emplace_back(right[k], x[k]);
    goals.push_back(tolerance * tolerance * descents[k].rz);
    if (descents[k].rz != 0.0) {
      left.push_back(k);
    } else {
      // Nothing to do; but a product that underflows, beside huge numbers of vertices left out, is no zero.
      converged[k] = std::ranges::all_of(x[k], [](double value) { return value == 0.0; }) ? 1 : 0;
    }
  }
  for (int iteration = 0; iteration < max_iterations && !left.empty(); ++iteration) {
    std::vector<const double*> from;
    std::vector<double*> to;
    for (const std::size_t k : left) {
      std::ranges::fill(descents[k].q, 0.0);
      from.push_back(descents[k].p.data());
      to.push_back(descents[k].q.data());
    }
    A.add_products(from, to);
    std::erase_if(left, [&](std::size_t k) {
      if (descents[k].go()) return false;
      converged[k] = 0;
      return true;
    });
    // The last residual is not looked at: that would take another solve.
    std::erase_if(left, [&](std::size_t k) { return descents[k].expected() <= goals[k]; });
    from.clear();
    to.clear();
    for (const std::size_t k : left) {
      from.push_back(descents[k].r.data());
      to.push_back(descents[k].z.data());
    }
    factor.solve(from, to, workspace);
    for (const std::size_t k : left) descents[k].turn();
    std::erase_if(left, [&](std::size_t k) { return descents[k].rz <= goals[k]; });
  }
  for (const std::size_t k : left) converged[k] = 0;
  for (std::size_t k = 0; k < b.size(); ++k) {
    x[k] = std::move(descents[k].x);
    for (double& value : x[k]) value *= units[k];
  }
  return converged;
}

}  // namespace diffcloth::linalg
