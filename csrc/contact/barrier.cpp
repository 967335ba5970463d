#include "contact/barrier.h"

#include <cmath>
#include <limits>

namespace diffcloth::contact {

double barrier(double d_sq, double xi, double d_hat) {
  const double sigma = d_sq - xi * xi;
  const double s = d_hat * (2.0 * xi + d_hat);
  if (sigma >= s) return 0.0;
  if (!(sigma > 0.0)) return std::numeric_limits<double>::infinity();
  const double r = sigma - s;
  return -d_hat / (s * s) * r * r * std::log(sigma / s);
}

Barrier barrier_derivatives(double d_sq, double xi, double d_hat) {
  const double sigma = d_sq - xi * xi;
  const double s = d_hat * (2.0 * xi + d_hat);
  if (sigma >= s) return {};
  const double a = d_hat / (s * s);
  const double r = sigma - s;
  const double log = std::log(sigma / s);

  const double b = -a * r * r * log;
  const double b1 = -a * (2.0 * r * log + r * r / sigma);
  const double b2 = -a * (2.0 * log + 4.0 * r / sigma - r * r / (sigma * sigma));

  // At fixed sigma, with respect to s (through a = d_hat/s^2, too).
  const double b_s = -2.0 / s * b + a * (2.0 * r * log + r * r / s);
  const double b1_s = -2.0 / s * b1 + a * (2.0 * log + 2.0 * r / s + 2.0 * r / sigma);
  const double s_d_hat = 2.0 * (xi + d_hat);
  const double s_xi = 2.0 * d_hat;
  const double sigma_xi = -2.0 * xi;
  return {.b = b,
          .b1 = b1,
          .b2 = b2,
          .b_d_hat = b / d_hat + b_s * s_d_hat,
          .b1_d_hat = b1 / d_hat + b1_s * s_d_hat,
          .b_xi = b1 * sigma_xi + b_s * s_xi,
          .b1_xi = b2 * sigma_xi + b1_s * s_xi};
}

}  // namespace diffcloth::contact
