#pragma once

#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include "bodies/coordinate_potential.h"
#include "contact/contact_set.h"
#include "potential/proximity.h"
#include "solver/coordinates.h"
#include "solver/objective.h"
#include "solver/pattern_cache.h"
#include "step/inputs.h"
#include "step/scene.h"
#include "step/step_potential.h"

namespace diffcloth::step {

/// One environment's step, prepared: the potentials that its scheme minimizes, from its inputs.
///
/// Forward and backward build equal problems, so that both see the same bits.
class Problem {
 public:
  /// @param wanted  requested gradients; null: none
  Problem(const Scene& scene, const Inputs& inputs, const Gradients* wanted = nullptr);
  Problem(const Problem&) = delete;
  Problem& operator=(const Problem&) = delete;

  const Scene& scene;
  const Inputs& inputs;
  double h;
  solver::Coordinates coordinates;
  std::size_t cloth_size;  ///< 3 N

 private:
  mesh::RestShape own_rest_;

 public:
  const mesh::RestShape* rest;  ///< rest shape of the scene, or of the rest_positions input
  contact::RestMeasures measures;
  std::vector<double> density;  ///< [F]
  std::vector<double> masses;   ///< [N] lumped [kg]
  std::vector<double> start;    ///< x_n and o_n: all points at the start of the step
  std::vector<double> ends;     ///< like start, with prescribed points at their targets
  std::vector<double> origins;  ///< like start, vertices at friction_origins; empty: at the start

  Proximity inertia;  ///< metric M, target xhat = x_n + h v_n + h^2 (gravity + M^-1 f)
  std::vector<std::unique_ptr<StepPotential>> potentials;  ///< see make_potentials()
  std::optional<bodies::CoordinatePotential> chart;        ///< absent without free coordinates
  std::optional<contact::ContactModel> contact;            ///< absent if nothing can touch

  /// Origin of the displacements in friction.
  const std::vector<double>& moved_from() const { return origins.empty() ? start : origins; }

  /// All of `potentials`.
  std::vector<Potential*> cloth_potentials() const;

  /// The member of `potentials` of this type.
  template <class Kind>
  Kind& find() const {
    for (const auto& potential : potentials) {
      if (auto* const found = dynamic_cast<Kind*>(potential.get())) return *found;
    }
    throw std::logic_error("step: no such potential");
  }

  /// A sum of potentials over the cloths' vertices, without contact.
  solver::Objective objective(Proximity& inertia,
                              std::vector<Potential*> others,
                              solver::PatternCache& patterns);

  /// All points, with these rows, and prescribed points at their targets.
  std::vector<double> at(const double* rows) const;

  /// All points, with cloths at x_n + h v_n, and prescribed points at their targets.
  std::vector<double> coasting() const;

  /// All points, with these cloth positions, free coordinates at their targets t as far as the limit on
  /// their speed allows, and prescribed points at their targets.
  std::vector<double> predicted(const double* cloth_positions) const;
};

/// Hessian of inertia and the potentials of the cloths at x, all points.
linalg::BlockMatrix contact_free_hessian(Problem& problem, const double* x, Curvature curvature);

/// A parameter given as one value, one a cloth or one a face, for each face.
std::vector<double> values_per_face(const Problem& problem, Input input);

/// Adjoint of values_per_face(): adds the sums, in order, to the gradient of the input, if wanted.
void add_per_face(const Problem& problem,
                  Input input,
                  const std::vector<double>& bar,
                  const Gradients& gradients);

/// Quantity per area of faces, lumped at vertices: each corner gets a third of its face [N].
std::vector<double> lumped(const Problem& problem, const std::vector<double>& per_face);

}  // namespace diffcloth::step
