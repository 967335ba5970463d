#include "contact/friction.h"

namespace diffcloth::contact {

FrictionLaw friction_law(double y, double e) {
  if (y >= e) {
    return {.f0 = y,
            .f1_over_y = 1.0 / y,
            .f2 = -1.0 / (y * y * y),
            .f1_over_y_e = 0.0,
            .f0_e = 0.0};
  }
  const double r = y / e;
  return {.f0 = y * r * (1.0 - r / 3.0) + e / 3.0,
          .f1_over_y = (2.0 - r) / e,
          .f2 = y > 0.0 ? -1.0 / (y * e * e) : 0.0,
          .f1_over_y_e = (2.0 * r - 2.0) / (e * e),
          .f0_e = r * r * (2.0 * r / 3.0 - 1.0) + 1.0 / 3.0};
}

}  // namespace diffcloth::contact
