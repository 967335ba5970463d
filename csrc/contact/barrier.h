#pragma once

namespace diffcloth::contact {

/// Physically normalized barrier of the squared distance D [m]:
///
///   b = -(d_hat / s^2) (sigma - s)^2 ln(sigma / s),  sigma = D - xi^2,  s = 2 xi d_hat + d_hat^2
///
/// for 0 < sigma < s; 0 above; +infinity at and below sigma = 0. It is C2 at sigma = s.
///
/// [Li et al. 2020; 2021 for the thickness xi]
double barrier(double d_sq, double xi, double d_hat);

/// b and its derivatives. b1 and b2 are with respect to D; those with respect to d_hat and xi are
/// total, at fixed D.
struct Barrier {
  double b, b1, b2;
  double b_d_hat, b1_d_hat;
  double b_xi, b1_xi;
};
Barrier barrier_derivatives(double d_sq, double xi, double d_hat);

}  // namespace diffcloth::contact
