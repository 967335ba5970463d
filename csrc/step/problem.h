#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "step/inputs.h"
#include "step/scene.h"

namespace diffcloth::step {

/// One environment's step, prepared: the objectives that its scheme minimizes, from its inputs.
///
/// Forward and backward build the same one, so that both see the same bits.
class Problem {
 public:
  Problem(const Scene& scene, const Inputs& inputs);
  Problem(const Problem&) = delete;
  Problem& operator=(const Problem&) = delete;

  const Scene& scene;
  const Inputs& inputs;
  double h;

  const mesh::RestShape* rest;  ///< the scene's, or that of the rest_positions input
  contact::RestMeasures measures;
  std::vector<double> density;    ///< [F]
  std::vector<double> masses;     ///< [N] lumped [kg]
  std::vector<double> predicted;  ///< xhat = x_n + h v_n + h^2 M^-1 f_ext [3 N]
  std::vector<double> start;      ///< x_n and o_n: all vertices at the start of the step
  std::vector<double> ends;       ///< like start, prescribed vertices at their targets
  elastic::Model elastic;
  std::vector<double> anchor_stiffness;  ///< [Q]
  elastic::Anchors anchors;
  std::optional<contact::ContactModel> contact;  ///< absent where nothing can touch

  /// Inertia, elasticity, anchors and, for `coupled`, contact.
  solver::Objective elastic_objective() const;
  /// Second stage of `split`: proximity to x_d in the metric G, and contact.
  solver::Objective contact_objective(const double* x_d) const;
  /// The objective that contact is part of.
  solver::Objective main_objective(const double* x_d) const;

  /// G_i of the second stage of `split` [kg].
  std::vector<double> stage_metric() const;

  bool split() const { return scene.given.scheme == Scheme::kSplit; }
  const contact::BroadPhase* broad_phase() const { return contact ? &scene.broad_phase : nullptr; }

  /// All vertices, with these cloth positions and the bodies at their targets.
  std::vector<double> with_bodies_at_end(const double* cloth_positions) const;

 private:
  solver::Objective bare_objective() const;

  mesh::RestShape own_rest_;
};

/// Spread a parameter given as one value, one a cloth or one a face (owner) over all faces.
std::vector<double> spread(const View& view, const std::vector<Index>& owner);

/// Adjoint of spread(): out += the sums, in order.
void gather(const std::vector<double>& bar,
            const std::vector<Index>& owner,
            View view,
            double* out);

}  // namespace diffcloth::step
