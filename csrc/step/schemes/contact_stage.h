#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include "solver/newton.h"
#include "step/scheme.h"
#include "step/schemes/contact_sum.h"

namespace diffcloth::step {

/// Puts the tangents along a direction into the potentials of an objective but those that touch, for
/// Potential::add_tangent().
using SetTangents = std::function<void(std::size_t direction)>;

/// The stage of a scheme that contact is part of: inertia (or nearness), whatever else, barrier and
/// friction, minimized once for each friction iteration, with friction lagged at the solution before.
struct ContactStage {
  Proximity& inertia;
  const double* guess;  ///< where the cloths begin if the way there is free: all [N, 3] of them
  std::vector<Potential*> others;
  solver::PatternCache& patterns;
  std::size_t first_factor;      ///< place of its factors among the scheme's
  const Potential* attachments;  ///< of cloths to bodies, as they count here
  Turn::Exchange exchange;       ///< of the cotangents of its potentials; only backward needs it
  SetTangents set_tangents;      ///< of its potentials; only tangent needs it

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

/// zhat of one solve, and everything it pulls back but the lag: see contact_stage.cpp. All losses are
/// solved for at once.
///
/// @param x            all points where the objective has been minimized; its potentials stand there
/// @param factor       of the exact Hessian there, or null to make it
/// @param g            of each loss, cotangent of the rows
/// @param with_forces  whether this solve yields the forces of the step
/// @param touching     the potentials of the objective that contact forces are of
/// @param exchange     of the cotangents of the objective's potentials
void pull_back_solve(const Backward& step,
                     const solver::Objective& objective,
                     const std::vector<double>& x,
                     solver::Certificate certificate,
                     const std::vector<std::vector<double>>& g,
                     bool with_forces,
                     const std::vector<contact::TouchingPotential*>& touching,
                     const Turn::Exchange& exchange);

/// How the solution of one solve changes along each direction: all points. See contact_tangent.cpp.
///
/// @param x             all points where the objective has been minimized; its potentials stand there
/// @param certificate   of the exact Hessian there, or none to make it
/// @param with_forces   whether this solve yields the forces of the step
/// @param touching      the potentials of the objective that contact forces are of; the tangents along all
///                      directions are in them
/// @param set_tangents  of the other potentials
std::vector<std::vector<double>> push_forward_solve(
    const Pushforward& step,
    const solver::Objective& objective,
    const std::vector<double>& x,
    solver::Certificate certificate,
    bool with_forces,
    const std::vector<contact::TouchingPotential*>& touching,
    const SetTangents& set_tangents);

/// Fold the outcome of one solve into the report: the criterion of the first that failed, else of the last.
void merge(const solver::Outcome& outcome, Report& report);

}  // namespace diffcloth::step
