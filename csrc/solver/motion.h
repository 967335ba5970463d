#pragma once

#include <vector>

#include "solver/walk.h"

namespace diffcloth::solver {

/// Motion of all prescribed points (pins, bodies, joints, frames) over the step, in portions. Each
/// portion is short enough that straight motion between its ends does not distort a turning body.
class PrescribedMotion {
 public:
  virtual ~PrescribedMotion() = default;
  virtual int portions() const = 0;

  /// Write the prescribed points at a fraction of the motion into x; portion k ends at (k + 1) /
  /// portions.
  virtual void at(double fraction, double* x) const = 0;
};

/// Move the prescribed points to their ends, together with the unknowns.
///
/// Each iteration descends with the projected Hessian, prescribed points at rest, then follows the
/// prescribed motion with the same Hessian as far as the path is free of collisions
/// (descend_and_follow()). Energies are not compared while the prescribed points move, as their motion
/// does work. Even a motion of length zero takes one iteration: the start of a solve does not depend on
/// whether something moves.
///
/// If the motion is blocked, the iterate returns to the last point at which all prescribed points can be
/// placed on their motion: between the ends of a portion, turning bodies are distorted.
///
/// @param descends  false: no descent unless the motion is blocked, so that a solution stays unchanged
///                  by a motion of length zero
/// @return the fraction of the motion that was reached: 1 for all of it
double arrive(Walk& walk, const PrescribedMotion& motion, bool descends);

}  // namespace diffcloth::solver
