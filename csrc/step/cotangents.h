#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include "step/problem.h"

namespace diffcloth::step {

/// Cotangents of what the potentials of a step depend on, before they are pulled back to the inputs.
///
/// The potentials of a problem keep those of their own parameters, of one loss at a time: see Turn.
class Cotangents {
 public:
  explicit Cotangents(const Problem& problem);

  /// y = xhat = x_n + h v_n + h^2 (gravity + f / m): pull the inertia's target and metric back.
  void add_predicted(Problem& problem, const Gradients& gradients);

  /// Write everything into the gradients of the inputs.
  void write(Problem& problem, const Gradients& gradients);

  std::vector<double> rows;         ///< of the outputs x_{n+1}, v_{n+1} / h included, and q_{n+1}
  std::vector<double> start;        ///< x_n and o_n: all points
  std::vector<double> origins;      ///< what friction counts motion from, where it is not the start
  std::vector<double> ends;         ///< what is prescribed, at its end: all points
  std::vector<double> velocities;   ///< v_n
  std::vector<double> masses;       ///< [N]
  std::vector<double> body_forces;  ///< of the output [3 V]
  std::vector<double> body_poses;   ///< of the poses at the start, beyond what `start` pulls back
  std::vector<double> body_targets;  ///< likewise, at the end
  contact::ContactModel::Bar contact;

  /// Swap what the problem's potentials have accumulated with what they have for this loss.
  void exchange(Problem& problem);

 private:
  std::vector<double> metric_, target_;                   // of inertia
  elastic::Bar elastic_;                                  // empty where it is zero
  std::vector<double> anchor_stiffness_, anchor_target_;  // of soft pins
  std::vector<double> chart_target_, chart_metric_;       // of coordinates
};

/// What potentials accumulate, and what is read from them, belongs to this loss while it lasts.
class Turn {
 public:
  using Exchange = std::function<void(std::size_t loss)>;

  Turn(const Exchange& exchange, std::size_t loss) : exchange_(exchange), loss_(loss) {
    exchange_(loss_);
  }
  ~Turn() { exchange_(loss_); }
  Turn(const Turn&) = delete;
  Turn& operator=(const Turn&) = delete;

 private:
  const Exchange& exchange_;
  std::size_t loss_;
};

}  // namespace diffcloth::step
