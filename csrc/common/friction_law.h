#pragma once

namespace diffcloth {

/// Smoothed Coulomb friction as a function of the tangential slip y >= 0 [m], with e = eps_v h [m]:
///
///   f0   = y^2 (1 - y / (3 e)) / e + e / 3     for y < e,   y       beyond
///   f1/y = (2 - y / e) / e                                  1 / y
///   f2   = (f1' y - f1) / y^3 = -1 / (y e^2)                -1 / y^3
///
/// mu lambda f0 is the dissipation potential, mu lambda (f1/y) w the force that opposes the slip w,
/// and mu lambda ((f1/y) I + f2 w w^T) its derivative by w. f2 w w^T vanishes with y: f2 is
/// returned as 0 if it would overflow.
struct FrictionLaw {
  double f0;
  double f1_over_y;
  double f2;
  double f1_over_y_e;  ///< d(f1/y)/de
  double f0_e;         ///< df0/de
};

FrictionLaw friction_law(double y, double e);

}  // namespace diffcloth
