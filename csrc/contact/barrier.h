#pragma once

namespace diffcloth::contact {

/// Barrier of the squared distance D between surfaces of thickness xi, active up to xi + d_hat [m].
///
///   sigma = D - xi^2,   s = 2 xi d_hat + d_hat^2
///   b = -(d_hat / s^2) (sigma - s)^2 ln(sigma / s)   for 0 < sigma < s,
///   b = 0 for sigma >= s,   b = +infinity for sigma <= 0.
///
/// b is a length: its product with a stiffness [Pa] and an area is an energy. b1 and b2 are derivatives
/// by D; derivatives by d_hat and xi hold D fixed and include the dependence of sigma and s.
struct Barrier {
  double b;
  double b1;
  double b2;
  double b_d_hat;
  double b1_d_hat;
  double b_xi;
  double b1_xi;
};

double barrier(double D, double xi, double d_hat);

/// Value and derivatives. For sigma <= 0 only b is defined; the derivatives are NaN.
Barrier barrier_derivatives(double D, double xi, double d_hat);

}  // namespace diffcloth::contact
