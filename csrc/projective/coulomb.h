#pragma once

#include <cstdint>

#include "common/types.h"

namespace diffcloth::projective {

/// The three cases of the law of Signorini and Coulomb (the paper's Eq. 3).
enum class ContactCase : std::uint8_t { kTakingOff, kSticking, kSlipping };

/// The law at one contact: the impulse r as a function of s = r - m u, with the relative velocity u and
/// a mass m > 0. Impulse and velocity obey the law exactly if r = impulse(r - m u): the case depends on
/// s, not on r.
///
///   taking off   s_n <= 0              r = 0
///   sticking     |s_T| <= mu s_n       r = s                        hence u = 0
///   slipping     else                  r = s_n n + mu s_n t,  t = s_T / |s_T|,   hence u_n = 0
struct Coulomb {
  ContactCase kind = ContactCase::kTakingOff;
  Vec3 impulse = Vec3::Zero();    ///< [N s]
  Vec3 direction = Vec3::Zero();  ///< t, if slipping
  /// If slipping: mu s_n / (|s_T| - mu s_n). Orthogonal to the slip, friction responds to the velocity
  /// like a damper: dr = -ratio m du.
  double ratio = 0.0;
};

Coulomb coulomb(const Vec3& s, const Vec3& normal, double friction);

}  // namespace diffcloth::projective
