#pragma once

#include <array>

#include "common/types.h"

namespace diffcloth::elastic {

// Quadratic forms Q on the second derivatives (uu, uv, vv) of a bending element in its rest frame, see
// bending.h.

/// |uu + vv|^2 - 2 (1 - nu) (uu . vv - |uv|^2), and its derivative with respect to nu.
Mat3 isotropic_form(double poisson);
Mat3 isotropic_form_derivative();

/// Bending stiffness of a woven triangle. With a along the warp and b along the weft,
///
///   D_w |aa|^2 + D_f |bb|^2 + 2 nu sqrt(D_w D_f) aa . bb + c |ab|^2,
///   c = 4 D_t - D_w - D_f - 2 nu sqrt(D_w D_f),
///
/// so that a cylinder bent at an angle phi to the warp has the stiffness
///
///   D_w cos^4 phi + D_f sin^4 phi + (4 D_t - D_w - D_f) cos^2 phi sin^2 phi:
///
/// D_t if it is bent along the twill, at 45 degrees. If the three are equal, the form is D times the
/// isotropic form.
struct Plate {
  double warp;     ///< D_w [N m]
  double weft;     ///< D_f [N m]
  double twill;    ///< D_t [N m]
  double poisson;  ///< nu [-]
  Vec2 axis;       ///< unit vector along the warp in the rest frame

  bool is_isotropic() const { return warp == weft && warp == twill; }
};

/// [N m]
Mat3 plate_form(const Plate& plate);

/// Derivatives of plate_form() by D_w, D_f, D_t and nu. If D_w and D_f are both zero, the root has no
/// derivative; half of its derivative along equal changes of both is assigned to each.
std::array<Mat3, 4> plate_form_derivatives(const Plate& plate);

}  // namespace diffcloth::elastic
