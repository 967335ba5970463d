#include "common/friction_law.h"

#include <limits>

namespace diffcloth {

FrictionLaw friction_law(double y, double e) {
  if (!(y < e)) {
    return {.f0 = y, .f1_over_y = 1 / y, .f2 = -1 / (y * y * y), .f1_over_y_e = 0, .f0_e = 0};
  }
  const double r = y / e;
  const double y_e_sq = y * e * e;
  return {.f0 = y * r * (1 - r / 3) + e / 3,
          .f1_over_y = (2 - r) / e,
          .f2 = y_e_sq > std::numeric_limits<double>::min() ? -1 / y_e_sq : 0.0,
          .f1_over_y_e = -2 * (1 - r) / (e * e),
          .f0_e = 1.0 / 3 - r * r * (1 - 2 * r / 3)};
}

}  // namespace diffcloth
