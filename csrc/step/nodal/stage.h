#pragma once

#include <vector>

#include "projective/local_global.h"
#include "solver/newton.h"
#include "step/nodal/contacts.h"
#include "step/scheme.h"

namespace diffcloth::step {

/// The stage of a scheme that has dry frictional contact at nodes: inertia, elasticity and anchors,
/// with the law of Signorini and Coulomb at each node in contact (the paper's Eqs. 3-5). Contacts are
/// found once, on the straight path from x_n to the inertial prediction.
///
/// See nodal/system.cpp for the equations, nodal/adjoint.cpp for their adjoint.
class NodalStage {
 public:
  explicit NodalStage(Problem& problem) : problem_(problem), contacts_(problem) {}
  NodalStage(const NodalStage&) = delete;
  NodalStage& operator=(const NodalStage&) = delete;

  bool has_contacts() const { return !contacts_.list.empty(); }

  /// Initial iterate of a solve: every vertex flies freely; vertices in contact obey the law
  /// independently.
  ///
  /// @param x  in: all points at the inertial prediction, prescribed ones at their ends
  void start(std::vector<double>& x) const;

  /// Solve by a semismooth Newton method.
  ///
  /// @param x  in: a start; out: the solution
  solver::Outcome solve(solver::Context& context, std::vector<double>& x) const;

  /// Solve by accelerated local/global iterations with impulses (Ly et al. 2020), which are given up if
  /// they stall.
  ///
  /// @param smooth  the objective without contact
  /// @param x  in: a start; out: the solution
  projective::LocalGlobalOutcome iterate(const projective::LocalGlobalObjective& smooth,
                                         const projective::LocalGlobalOptions& options,
                                         const Checkpoint& checkpoint,
                                         std::vector<double>& x) const;

  /// Count the cases of the law at a solution, and add the forces there; forces on the bodies' vertices
  /// are minus the forces on the nodes, shared by the corners of the nearest faces.
  void finish(const std::vector<double>& x, Report& report, const Forces& forces) const;

  /// The adjoint, for a solution x.
  ///
  /// @param factor  from solve(), or null to recompute it
  /// @param g       cotangent of the rows at the end
  /// @param bars    of the current loss
  void backward(const Backward& step,
                const std::vector<double>& x,
                solver::Factor factor,
                const std::vector<double>& g,
                Cotangents& bars) const;

  /// Change of all points along a direction, for a solution x; the change of the forces is added to the
  /// step's. The potentials have the tangents of the direction.
  ///
  /// @param factor  from solve(), or null to recompute it
  std::vector<double> tangent(const Pushforward& step,
                              const std::vector<double>& x,
                              solver::Factor factor,
                              std::size_t direction) const;

 private:
  /// Inertia, elasticity and anchors.
  solver::Objective objective() const;

  Problem& problem_;
  NodalContacts contacts_;
};

}  // namespace diffcloth::step
