#pragma once

#include <cstdint>

#include "common/types.h"

namespace diffcloth::projective {

/// The three cases of the law of Signorini and Coulomb (the paper's Eq. 3).
enum class ContactCase : std::uint8_t { kTakingOff, kSticking, kSlipping };

/// The law at one contact: what the impulse r must be where s = r - m u, with the relative velocity u
/// and a mass m > 0. Impulse and velocity obey the law exactly where r = impulse(r - m u): s and not r
/// decides on the case.
///
///   taking off   s_n <= 0              r = 0
///   sticking     |s_T| <= mu s_n       r = s                        hence u = 0
///   slipping     else                  r = s_n n + mu s_n t,  t = s_T / |s_T|,   hence u_n = 0
struct Coulomb {
  ContactCase kind = ContactCase::kTakingOff;
  Vec3 impulse = Vec3::Zero();    ///< [N s]
  Vec3 direction = Vec3::Zero();  ///< t of slipping
  /// Of slipping: mu s_n / (|s_T| - mu s_n). Across the slip, friction turns with the velocity like a
  /// damper of this many masses: dr = -ratio m du.
  double ratio = 0.0;
};

Coulomb coulomb(const Vec3& s, const Vec3& normal, double friction);

}  // namespace diffcloth::projective
