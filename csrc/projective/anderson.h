#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>

namespace diffcloth::projective {

/// Anderson acceleration of a fixed-point iteration  x <- x + p(x)  (Anderson 1965; for Projective
/// Dynamics Peng et al. 2018).
///
/// From the last steps it takes the combination whose p would be the smallest, were p affine, in the
/// norm of the constant matrix: |p|^2 = p . q with q = A p, which the caller has at hand, as p is
/// found from it.
class Anderson {
 public:
  /// Steps that are combined. Five take two to four times as many iterations to small residuals,
  /// and more than twenty gain little.
  static constexpr int kWindow = 20;

  explicit Anderson(std::size_t size);

  /// Where to go from x: x + p, or better. All arrays have the size of the iteration.
  ///
  /// @param to  out; none of the others
  void next(const double* x, const double* p, const double* q, double* to);

 private:
  using Gram = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kWindow, kWindow>;

  struct Change {
    std::vector<double> step;  ///< of x + p
    std::vector<double> p, q;
  };

  std::size_t size_;
  std::vector<Change> changes_;  // a ring
  int count_ = 0;                // of changes in use
  int newest_ = -1;
  Gram products_;  // of the changes' p and q
  bool has_last_ = false;
  std::vector<double> last_end_, last_p_, last_q_;
};

}  // namespace diffcloth::projective
