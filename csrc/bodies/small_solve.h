#pragma once

#include <Eigen/LU>

#include "bodies/tree.h"
#include "common/recorded.h"

namespace diffcloth::bodies {

// Small linear systems, of doubles or of recorded numbers.

template <class T>
VectorX<T> pick(const VectorX<T>& values, const std::vector<Index>& rows) {
  VectorX<T> picked(static_cast<Index>(rows.size()));
  for (std::size_t i = 0; i < rows.size(); ++i) picked[static_cast<Index>(i)] = values[rows[i]];
  return picked;
}

template <class T>
MatrixX<T> pick(const MatrixX<T>& values, const std::vector<Index>& rows) {
  const auto n = static_cast<Index>(rows.size());
  MatrixX<T> picked(n, n);
  for (Index i = 0; i < n; ++i) {
    for (Index j = 0; j < n; ++j) picked(i, j) = values(rows[i], rows[j]);
  }
  return picked;
}

/// Solution x of M x = v.
inline Eigen::VectorXd solve(const Eigen::MatrixXd& M, const Eigen::VectorXd& v) {
  return M.partialPivLu().solve(v);
}

/// Point x with the derivative -K^-1 dr, for a known root x of r = 0, however it was found; K is dr/dx.
inline VectorX<Recorded> with_derivative(const Eigen::VectorXd& x,
                                         const Eigen::MatrixXd& K,
                                         const VectorX<Recorded>& r) {
  const Eigen::MatrixXd inverse = K.inverse();
  VectorX<Recorded> result(x.size());
  for (Eigen::Index i = 0; i < x.size(); ++i) {
    result[i] = x[i];
    // The added value is zero; only the derivatives are recorded.
    for (Eigen::Index j = 0; j < x.size(); ++j) result[i] -= inverse(i, j) * (r[j] - r[j].value);
  }
  return result;
}

inline VectorX<Recorded> solve(const MatrixX<Recorded>& M, const VectorX<Recorded>& v) {
  const Eigen::MatrixXd numbers = M.unaryExpr([](const Recorded& m) { return m.value; });
  const Eigen::VectorXd right = v.unaryExpr([](const Recorded& x) { return x.value; });
  const Eigen::VectorXd x = solve(numbers, right);
  return with_derivative(x, numbers, M * x.cast<Recorded>() - v);
}

}  // namespace diffcloth::bodies
