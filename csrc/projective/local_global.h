#pragma once

#include <cstdint>
#include <vector>

#include "common/interrupt.h"
#include "potential/potential.h"
#include "projective/constant_matrix.h"

namespace diffcloth::projective {

/// Objective of local/global iterations: a sum of potentials over the cloths' vertices.
struct LocalGlobalObjective {
  std::vector<const Potential*> potentials;
  const ConstantMatrix* matrix;       ///< A: at least their Hessian, or of its magnitude
  const std::vector<double>* masses;  ///< [N] [kg]
  double h;                           ///< time step [s]

  /// g = grad P at x.
  void gradient(const std::vector<double>& x, std::vector<double>& g) const;

  /// max_i h |f_i| / m_i over the free vertices [m/s]; infinite if a force is not finite.
  double largest_rate(const std::vector<double>& force) const;
};

struct LocalGlobalOptions {
  double tolerance;             ///< on max_i h |g_i| / m_i over the free vertices [m/s]
  std::int64_t max_iterations;  ///< of this solve
};

enum class LocalGlobalStatus : std::uint8_t {
  kConverged,
  kIterationLimit,
  kTimeLimit,
  kNoProgress,  ///< steps vanish in the rounding of positions, raise the energy, or do not shrink
  kStalled,     ///< contact at nodes: the residual no longer shrinks
  kOverflow,    ///< forces are not finite
};

struct LocalGlobalOutcome {
  LocalGlobalStatus status = LocalGlobalStatus::kIterationLimit;
  double residual = 0.0;        ///< max_i h |g_i| / m_i at x [m/s]
  std::int64_t iterations = 0;  ///< global solves
};

/// Find a stationary point of an objective by local/global iterations (Bouaziz et al. 2014; the paper's
/// Sec. III.B) with Anderson acceleration.
///
/// One iteration is  x <- x - A^-1 grad P(x). For terms 1/2 |S x - R(x)|^2, with R the nearest point of
/// the constraint set, this is the local projection and the global solve, as grad P = A x - b(x). Other
/// terms enter by their gradient, so that the solution is a stationary point of the potentials, for any
/// A. The energy never rises: an accelerated step that would raise it is replaced by the plain one,
/// which is halved if it raises the energy too.
///
/// The curvature at the solution is not checked: from a symmetric start it may be a saddle.
///
/// @param x  in: a start, [N, 3] followed by other points of the potentials; out: the solution, or the
/// last iterate with a finite gradient. Pins are unchanged.
LocalGlobalOutcome minimize(const LocalGlobalObjective& objective,
                            std::vector<double>& x,
                            const LocalGlobalOptions& options,
                            const Checkpoint& checkpoint);

}  // namespace diffcloth::projective
