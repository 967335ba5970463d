#pragma once

namespace diffcloth::contact {

/// Smoothed Coulomb friction over a sliding distance y, with static friction below e = eps_v h:
///
///   f0 = y^2 (1 - y/(3 e))/e + e/3  (y < e),  y  (y >= e);   f1 = f0'
///
/// [Li et al. 2020], the paper's Eq. 14 with its second case mended.
struct FrictionLaw {
  double f0;           ///< [m]
  double f1_over_y;    ///< f1 / y, with its limit at y = 0
  double f2;           ///< (f1' y - f1) / y^3; 0 at y = 0, where it multiplies a zero
  double f1_over_y_e;  ///< d(f1 / y)/de
  double f0_e;         ///< d(f0)/de
};
FrictionLaw friction_law(double y, double e);

}  // namespace diffcloth::contact
