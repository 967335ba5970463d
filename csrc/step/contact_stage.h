#pragma once

#include <cstddef>
#include <string_view>
#include <vector>

#include "solver/newton.h"
#include "step/scheme.h"

namespace diffcloth::step {

/// The stage of a scheme that contact is part of: inertia (or nearness), whatever else, barrier and
/// friction, minimized once for each friction iteration, with friction lagged at the solution before.
struct ContactStage {
  Proximity& inertia;
  std::vector<Potential*> others;
  solver::AssemblyCache& assemblies;
  std::size_t first_factor;  ///< place of its factors among the scheme's

  /// What it keeps on the tape.
  static std::vector<Field> tape(const Scene& scene);

  /// @param x  in: all points at the start of the step; out: at its end
  void forward(const Forward& step, std::vector<double>& x, double* body_forces);

  /// @param g  cotangent of the rows (cloth positions, coordinates) at the end
  void backward(const Backward& step, std::vector<double> g);
};

/// zhat of one solve, and everything it pulls back but the lag: see contact_stage.cpp.
///
/// @param x          all points where the objective has been minimized; its potentials stand there
/// @param factor     of the exact Hessian there, or null to make it
/// @param force_bar  cotangents of the forces on the bodies' vertices, or null
void pull_back_solve(const Backward& step,
                     const solver::Objective& objective,
                     const std::vector<double>& x,
                     solver::Factor factor,
                     const std::vector<double>& g,
                     const std::vector<double>* force_bar);

/// Fold the outcome of one minimization into the report.
void merge(const solver::Outcome& outcome, Report& report);

}  // namespace diffcloth::step
