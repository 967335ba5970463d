#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include "solver/newton.h"
#include "step/scheme.h"
#include "step/schemes/contact_sum.h"

namespace diffcloth::step {

/// Puts the tangents along a direction into all potentials of an objective except contact and friction,
/// for Potential::add_tangent().
using SetTangents = std::function<void(std::size_t direction)>;

/// The stage of a scheme with contact: inertia (or nearness), other potentials, barrier and friction,
/// minimized once for each friction iteration, with friction lagged at the previous solution.
struct ContactStage {
  Proximity& inertia;
  const double* guess;  ///< initial iterate of the cloths if the path to it is free [N, 3]
  std::vector<Potential*> others;
  solver::PatternCache& patterns;
  std::size_t first_factor;      ///< index of its first factor among the scheme's
  const Potential* attachments;  ///< springs between cloths and bodies, as weighted in this stage
  Turn::Exchange exchange;       ///< cotangents of the stage's potentials; for backward only
  SetTangents set_tangents;      ///< tangents of the stage's potentials; for tangent only

  /// Fields of the tape.
  static std::vector<Field> tape(const Scene& scene);

  /// @param x  in: all points at the start of the step; out: at its end
  void forward(const Forward& step, std::vector<double>& x, const Forces& forces);

  /// @param g  of each loss, cotangent of the rows (cloth positions, coordinates) at the end
  void backward(const Backward& step, std::vector<std::vector<double>> g);

  /// Change of all points at the end, along each direction.
  std::vector<std::vector<double>> tangent(const Pushforward& step);

 private:
  StagePotentials potentials() {
    return {.inertia = inertia, .others = others, .patterns = patterns};
  }
};

/// zhat of one solve, and its pull back to everything but the lag: see contact_adjoint.cpp. All losses
/// are solved for at once.
///
/// @param x            all points at the minimum of the objective; current point of its potentials
/// @param certificate  of the exact Hessian there, or none to recompute it
/// @param g            of each loss, cotangent of the rows
/// @param with_forces  true if this solve yields the forces of the step
/// @param touching     potentials of the objective that exert contact forces
/// @param exchange     of the cotangents of the objective's potentials
void pull_back_solve(const Backward& step,
                     const solver::Objective& objective,
                     const std::vector<double>& x,
                     solver::Certificate certificate,
                     const std::vector<std::vector<double>>& g,
                     bool with_forces,
                     const std::vector<contact::TouchingPotential*>& touching,
                     const Turn::Exchange& exchange);

/// Changes of all points at the solution of one solve along each direction. See contact_tangent.cpp.
///
/// @param x             all points at the minimum of the objective; current point of its potentials
/// @param certificate   of the exact Hessian there, or none to recompute it
/// @param with_forces   true if this solve yields the forces of the step
/// @param touching      potentials of the objective that exert contact forces; they hold the tangents
///                      along all directions
/// @param set_tangents  sets the tangents of the other potentials
std::vector<std::vector<double>> push_forward_solve(
    const Pushforward& step,
    const solver::Objective& objective,
    const std::vector<double>& x,
    solver::Certificate certificate,
    bool with_forces,
    const std::vector<contact::TouchingPotential*>& touching,
    const SetTangents& set_tangents);

/// Merge the outcome of one solve into the report: the criterion of the first failed solve, else of the
/// last.
void merge(const solver::Outcome& outcome, Report& report);

}  // namespace diffcloth::step
