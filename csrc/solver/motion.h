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

/// Walk what is prescribed to its ends, the unknowns along with it.
///
/// Joint Newton: H_xx p = -(g + H_xo do), both moved by the same collision-free fraction. No energy
/// is compared on the way, as the prescribed motion does work; a blocked step is followed by a
/// relaxation of the free vertices, which reopens the gaps that it has closed.
///
/// Where there is no way on, the walk goes back to the last point at which all that is prescribed can have
/// the place that its motion gives it: between the ends of a portion, bodies that turn are distorted.
///
/// @return the fraction of the motion that was reached: 1 for all of it
double arrive(Walk& walk, const PrescribedMotion& motion);

}  // namespace diffcloth::solver
