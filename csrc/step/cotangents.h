#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include "step/problem.h"

namespace diffcloth::step {

/// Cotangents of the quantities that the potentials of a step share, before they are pulled back to the inputs.
///
/// The potentials of a problem keep the cotangents of their own parameters for one loss at a time: see
/// Turn. A stage of a scheme adds a PullBack for its own cotangents.
class Cotangents {
 public:
  /// All zero.
  ///
  /// @param gradients  the requested gradients
  Cotangents(const Problem& problem, const Gradients& gradients);

  /// y = xhat = x_n + h v_n + h^2 (gravity + f / m): pull the inertia's target and metric back.
  void add_predicted(Problem& problem, const Gradients& gradients);

  /// Write all cotangents into the gradients of the inputs.
  void write(Problem& problem, const Gradients& gradients);

  std::vector<double> rows;            ///< bars of x_{n+1}, q_{n+1} and, divided by h, v_{n+1}
  std::vector<double> start;           ///< x_n and o_n: all points
  std::vector<double> origins;         ///< origins of friction's displacements, if not the start
  std::vector<double> ends;            ///< prescribed points at their ends: all points
  std::vector<double> velocities;      ///< v_n
  std::vector<double> masses;          ///< [N]
  std::vector<double> body_forces;     ///< bar of the output [3 V]
  std::vector<double> contact_forces;  ///< likewise [3 N]
  std::vector<double> pin_forces;      ///< likewise [3 P]
  contact::ContactModel::Bar contact;

  mesh::RestShapeBar rest;  ///< bar of the cloths' rest shape; empty if not requested

  /// Adds the cotangents that a stage keeps to the gradients of the inputs; called by write().
  using PullBack = std::function<void(const Gradients& gradients)>;
  std::vector<PullBack> of_stages;

  /// Swap the cotangents in the problem's potentials with the stored ones of this loss.
  void exchange(Problem& problem);

 private:
  CotangentStore store_;
};

/// Scope in which the cotangents in the potentials belong to one loss.
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

/// out += bar, unless out is null.
void add_to(double* out, const std::vector<double>& bar);

/// Adjoint of lumped(): adds to the gradient of the input that is given per face, and to the rest shape.
///
/// @param bar       of the lumped quantity [N]
/// @param per_face  the values of the input
void pull_back_lumped(const Problem& problem,
                      Input input,
                      const std::vector<double>& bar,
                      const std::vector<double>& per_face,
                      Cotangents& bars,
                      const Gradients& gradients);

}  // namespace diffcloth::step
