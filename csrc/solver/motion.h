#pragma once

#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

/// How what is prescribed (pins, bodies, joints, frames) moves over the step: in portions, each short
/// enough that straight motion between its ends does not distort a turning body.
class PrescribedMotion {
 public:
  virtual ~PrescribedMotion() = default;
  virtual int portions() const = 0;

  /// Write the prescribed points at a fraction of the motion into x; portion k ends at (k + 1) / portions.
  virtual void at(double fraction, double* x) const = 0;
};

/// Move the prescribed points to their ends, the unknowns along with them.
///
/// An iteration descends with the projected Hessian, prescribed points at rest, then follows the prescribed
/// motion by the same Hessian as far as that is free of collisions (descend_and_follow()). It compares no
/// energies while the prescribed points move, as their motion does work. Even a motion of length zero takes
/// one iteration: the start of a solve does not depend on whether something moves.
///
/// Where there is no way on, the walk goes back to the last point at which all that is prescribed can have
/// the place that its motion gives it: between the ends of a portion, bodies that turn are distorted.
///
/// @param descends  false: nothing descends unless the motion is blocked, so that a point that is a solution
///                  remains one where the motion has no length
/// @return the fraction of the motion that was reached: 1 for all of it
double arrive(Walk& walk, const PrescribedMotion& motion, bool descends);

}  // namespace diffcloth::solver
