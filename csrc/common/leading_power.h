#pragma once

#include <cmath>

namespace diffcloth {

/// Largest power of two up to a, for division without rounding; 1 if a is zero or not finite.
inline double leading_power(double a) {
  return a > 0.0 && std::isfinite(a) ? std::ldexp(1.0, std::ilogb(a)) : 1.0;
}

}  // namespace diffcloth
