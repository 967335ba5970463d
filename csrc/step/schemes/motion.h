#pragma once

#include <vector>

#include "solver/motion.h"
#include "step/problem.h"

namespace diffcloth::step {

/// The motion of pins, on straight lines, and bodies, along the geodesics of their poses.
class GeodesicMotion final : public solver::PrescribedMotion {
 public:
  explicit GeodesicMotion(const Problem& problem);

  int portions() const override { return portions_; }
  void at(double fraction, double* x) const override;

  /// Poses of all roots at a fraction of the motion, [T, 7].
  std::vector<double> root_poses(double fraction) const;

 private:
  const Problem& problem_;
  int portions_;
};

}  // namespace diffcloth::step
