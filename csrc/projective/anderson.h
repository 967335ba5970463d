#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>

namespace diffcloth::projective {

/// Anderson acceleration of a fixed-point iteration  x <- x + p(x)  (Anderson 1965; for Projective
/// Dynamics Peng et al. 2018).
///
/// The next iterate is the combination of the last steps with the smallest p, for affine p, in the norm
/// of the constant matrix: |p|^2 = p . q with q = A p. The caller has q already, as p is computed from
/// it.
class Anderson {
 public:
  /// Number of combined steps. Five need two to four times as many iterations to small residuals; more
  /// than twenty gain little.
  static constexpr int kWindow = 20;

  explicit Anderson(std::size_t size);

  /// Compute the next iterate from x: x + p, or its accelerated form. All arrays have the size of the
  /// iteration.
  ///
  /// @param to  out; must not alias the others
  void next(const double* x, const double* p, const double* q, double* to);

 private:
  using Gram = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kWindow, kWindow>;

  struct Change {
    std::vector<double> step;  ///< change of x + p
    std::vector<double> p, q;
  };

  std::size_t size_;
  std::vector<Change> changes_;  // ring buffer
  int count_ = 0;                // number of changes in use
  int newest_ = -1;
  Gram products_;  // dot products of the changes' p and q
  bool has_last_ = false;
  std::vector<double> last_end_, last_p_, last_q_;
};

}  // namespace diffcloth::projective
