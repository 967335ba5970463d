#include "linalg/conjugate_gradient.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "common/leading_power.h"

namespace diffcloth::linalg {
namespace {

/// Largest magnitude. Four maxima are computed side by side, because a single one is a chain of
/// dependent operations.
double largest_magnitude(const std::vector<double>& values) {
  std::array<double, 4> largest{};
  for (std::size_t k = 0; k < values.size(); ++k) {
    largest[k % 4] = std::max(largest[k % 4], std::abs(values[k]));
  }
  return *std::ranges::max_element(largest);
}

/// State of the iteration for one right-hand side.
struct Descent {
  /// @param b      [size or more]
  /// @param first  [size] the preconditioner applied to b
  Descent(std::vector<double> b, std::vector<double> first)
      : x(first.size(), 0.0), r(std::move(b)), z(first), p(std::move(first)), q(p.size()) {
    r.resize(p.size());
    rz = dot(r, z);
  }

  /// Move to the minimum along p. Returns false if the curvature along p is not positive.
  bool advance(const BlockValues& A) {
    std::ranges::fill(q, 0.0);
    A.add_product(p.data(), q.data());
    return go();
  }

  /// Same, with q = A p already computed.
  bool go() { return go(dot(p, q)); }

  /// Same, with p . q given.
  bool go(double curvature) {
    if (!(curvature > 0.0)) return false;
    const double alpha = rz / curvature;
    for (std::size_t k = 0; k < x.size(); ++k) {
      x[k] += alpha * p[k];
      r[k] -= alpha * q[k];
    }
    return true;
  }

  /// Compute the next direction, with z the preconditioner applied to r.
  void turn() { turn(dot(r, z)); }

  /// Same, with r . z given.
  void turn(double next) {
    const double beta = next / rz;
    last = rz;
    rz = next;
    for (std::size_t k = 0; k < p.size(); ++k) p[k] = z[k] + beta * p[k];
  }

  /// Expected squared residual after the next iteration, if it contracts as the last one did.
  double expected() const { return rz * rz / last; }

  std::vector<double> x, r, z, p, q;
  double rz = 0.0;
  double last = 0.0;  ///< rz before the last iteration
};

/// Dot products of two vectors of several right-hand sides, four at a time as independent operations.
std::vector<double> dots(const std::vector<Descent>& descents,
                         const std::vector<std::size_t>& of,
                         std::vector<double> Descent::* a,
                         std::vector<double> Descent::* b) {
  std::vector<double> sums(of.size(), 0.0);
  std::size_t first = 0;
  for (; first + 4 <= of.size(); first += 4) {
    std::array<const double*, 4> from_a{};
    std::array<const double*, 4> from_b{};
    for (std::size_t l = 0; l < 4; ++l) {
      from_a[l] = (descents[of[first + l]].*a).data();
      from_b[l] = (descents[of[first + l]].*b).data();
    }
    std::array<double, 4> sum{};
    const std::size_t size = (descents[of[first]].*a).size();
    for (std::size_t k = 0; k < size; ++k) {
      for (std::size_t l = 0; l < 4; ++l) sum[l] += from_a[l][k] * from_b[l][k];
    }
    std::ranges::copy(sum, sums.begin() + static_cast<std::ptrdiff_t>(first));
  }
  for (; first < of.size(); ++first) {
    sums[first] = dot(descents[of[first]].*a, descents[of[first]].*b);
  }
  return sums;
}

}  // namespace

Convergence conjugate_gradient(const BlockValues& A,
                               const CholeskyFactor& preconditioner,
                               const std::vector<double>& b,
                               double tolerance,
                               int max_iterations,
                               double fastest,
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
    if (descent.rz > goal * std::pow(fastest * fastest, left - 1)) break;
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
            const Agreement& agreement,
            CholeskyWorkspace& workspace) {
  Descent descent(b, x);
  const double first = agreement.first_contraction * agreement.first_contraction * descent.rz;
  const double goal = agreement.residual * agreement.residual * descent.rz;
  for (int iteration = 0; iteration < agreement.iterations; ++iteration) {
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
  // Squared residuals need twice the range of exponents: scale each right-hand side.
  std::vector<double> units;
  std::vector<std::vector<double>> right = b;
  for (std::vector<double>& values : right) {
    units.push_back(leading_power(largest_magnitude(values)));
    for (double& value : values) value /= units.back();
  }
  solve(factor, right, workspace, x);
  std::vector<Descent> descents;
  std::vector<char> converged(b.size(), 1);
  std::vector<std::size_t> left;
  std::vector<double> goals;
  for (std::size_t k = 0; k < b.size(); ++k) {
    descents.emplace_back(std::move(right[k]), x[k]);
    goals.push_back(tolerance * tolerance * descents[k].rz);
    if (descents[k].rz != 0.0) {
      left.push_back(k);
    } else {
      // Nothing to do. However, an underflow of r . z, next to huge numbers at vertices left out, is not
      // a zero residual.
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
    auto product = dots(descents, left, &Descent::p, &Descent::q);
    auto next = product.begin();
    std::erase_if(left, [&](std::size_t k) {
      if (descents[k].go(*next++)) return false;
      converged[k] = 0;
      return true;
    });
    // The last residual is not computed, because that would need another solve.
    std::erase_if(left, [&](std::size_t k) { return descents[k].expected() <= goals[k]; });
    from.clear();
    to.clear();
    for (const std::size_t k : left) {
      from.push_back(descents[k].r.data());
      to.push_back(descents[k].z.data());
    }
    factor.solve(from, to, workspace);
    product = dots(descents, left, &Descent::r, &Descent::z);
    next = product.begin();
    for (const std::size_t k : left) descents[k].turn(*next++);
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
