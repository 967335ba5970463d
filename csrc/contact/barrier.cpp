#include "contact/barrier.h"

#include <cmath>
#include <limits>

namespace diffcloth::contact {

// With r = sigma / s the barrier is b = d_hat phi(r), phi = -(r - 1)^2 ln r.

double barrier(double D, double xi, double d_hat) {
  const double sigma = D - xi * xi;
  const double s = 2 * xi * d_hat + d_hat * d_hat;
  if (sigma >= s) return 0;
  if (sigma <= 0) return std::numeric_limits<double>::infinity();
  const double below = sigma / s - 1;
  return d_hat * (-below * below * std::log(sigma / s));
}

Barrier barrier_derivatives(double D, double xi, double d_hat) {
  const double sigma = D - xi * xi;
  const double s = 2 * xi * d_hat + d_hat * d_hat;
  if (sigma >= s) return {};
  if (sigma <= 0) {
    constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
    return {.b = std::numeric_limits<double>::infinity(),
            .b1 = kNan,
            .b2 = kNan,
            .b_d_hat = kNan,
            .b1_d_hat = kNan,
            .b_xi = kNan,
            .b1_xi = kNan};
  }
  const double r = sigma / s;
  const double below = r - 1;
  const double ln_r = std::log(r);
  const double phi = -below * below * ln_r;
  const double phi1 = -2 * below * ln_r - below * below / r;
  const double phi2 = -2 * ln_r - 4 * below / r + below * below / (r * r);

  const double s_d_hat = 2 * (xi + d_hat);
  const double s_xi = 2 * d_hat;
  const double r_d_hat = -r * s_d_hat / s;
  const double r_xi = (-2 * xi - r * s_xi) / s;

  return {.b = d_hat * phi,
          .b1 = d_hat * phi1 / s,
          .b2 = d_hat * phi2 / (s * s),
          .b_d_hat = phi + d_hat * phi1 * r_d_hat,
          .b1_d_hat = (phi1 + d_hat * (phi2 * r_d_hat - phi1 * s_d_hat / s)) / s,
          .b_xi = d_hat * phi1 * r_xi,
          .b1_xi = d_hat * (phi2 * r_xi - phi1 * s_xi / s) / s};
}

}  // namespace diffcloth::contact
