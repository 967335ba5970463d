#pragma once

#include <vector>

#include "step/problem.h"

namespace diffcloth::step {

/// Cotangents of what the potentials of a step depend on, before they are pulled back to the inputs.
/// The potentials keep those of their own parameters.
struct Cotangents {
  explicit Cotangents(const Problem& problem);

  /// y = xhat = x_n + h v_n + h^2 (gravity + f / m): pull the inertia's target and metric back.
  void add_predicted(Problem& problem, const Gradients& gradients);

  /// Write everything into the gradients of the inputs.
  void write(Problem& problem, const Gradients& gradients);

  std::vector<double> rows;          ///< of the outputs x_{n+1}, v_{n+1} / h included, and q_{n+1}
  std::vector<double> start;         ///< x_n and o_n: all points
  std::vector<double> ends;          ///< what is prescribed, at its end: all points
  std::vector<double> velocities;    ///< v_n
  std::vector<double> masses;        ///< [N]
  std::vector<double> body_forces;   ///< of the output [3 V]
  std::vector<double> body_poses;    ///< of the poses at the start, beyond what `start` pulls back
  std::vector<double> body_targets;  ///< likewise, at the end
  contact::ContactModel::Bar contact;
};

}  // namespace diffcloth::step
