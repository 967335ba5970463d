#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// The coupled scheme with steps of second order where motion is smooth, and with the behavior of
/// implicit Euler in contact. From x_n and v_n:
///
///   1. Filter:  (M + h^2 S(u)) d = M h v_n,   u = x_n + h v_n / 2,  S the stiffness against strain rates;
///      prescribed points have d = their motion.
///   2. x' = argmin  1/(2 h^2) |x - xhat|^2_M + W(x - d) + D(x - d) + E(x) + barrier + friction + drag,
///      v' = (x' - x_n) / h,
///
/// W is the energy of elasticity and springs. D is the damping potential, by the mean of the strain
/// rates of the filter and of the step (elastic/damping.h); drag is evaluated at the mean of v_n and v'. E is the
/// energy of elastic/chord_strain.h, which keeps the strain small that d would cause where contact
/// turns faces.
///
/// With d = h v_n this is leapfrog on the Moreau envelope of W, with velocities at the middle of steps:
/// unconditionally stable, of second order. For modes that are fast compared with the step, the filter
/// yields implicit Euler. Contact, friction and gravity are treated as in implicit Euler, so that rest
/// is exact, and nothing is averaged that the barrier has changed. The balance of linear momentum holds
/// for every S.
class SecondOrder final : public Scheme {
 public:
  std::vector<Field> tape(const Scene& scene) const override;
  void forward(const Forward& step, std::vector<double>& x, const Forces& forces) const override;
  void backward(const Backward& step) const override;
  std::vector<std::vector<double>> tangent(const Pushforward& step) const override;
};

}  // namespace diffcloth::step
