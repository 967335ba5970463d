#pragma once

#include "solver/motion.h"
#include "step/problem.h"

namespace diffcloth::step {

/// The motion of pins, on straight lines, and bodies, along the geodesics of their poses.
class Motion final : public solver::PrescribedMotion {
 public:
  explicit Motion(const Problem& problem);

  int portions() const override { return portions_; }
  void end_of_portion(int k, double* x) const override;

 private:
  const Problem& problem_;
  int portions_;
};

}  // namespace diffcloth::step
