#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic_potential.h"
#include "potential/proximity.h"
#include "projective/constant_matrix.h"
#include "step/inputs.h"
#include "step/scene.h"

namespace diffcloth::step {

/// One environment's step, prepared: the potentials that its scheme minimizes, from its inputs.
///
/// Forward and backward build the same one, so that both see the same bits.
class Problem {
 public:
  /// @param wanted  which cotangents of materials and the rest shape will be
  Problem(const Scene& scene,
          const Inputs& inputs,
          elastic::Wanted wanted = elastic::Wanted::kNone);
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
  const mesh::RestShape* rest;  ///< the scene's, or that of the rest_positions input
  contact::RestMeasures measures;
  std::vector<double> density;  ///< [F]
  std::vector<double> masses;   ///< [N] lumped [kg]
  std::vector<double> start;    ///< x_n and o_n: all points at the start of the step
  std::vector<double> ends;     ///< like start, what is prescribed at its targets
  std::vector<double> origins;  ///< like start, coordinates at their origins; empty: they have none

  Proximity inertia;  ///< metric M, target xhat = x_n + h v_n + h^2 (gravity + M^-1 f)
  elastic::Model model;
  elastic::ElasticPotential elasticity;
  std::vector<double> anchor_stiffness;  ///< [Q]
  std::optional<elastic::AnchorPotential> anchors;
  std::optional<bodies::CoordinatePotential> chart;  ///< absent without free coordinates
  std::optional<contact::ContactModel> contact;      ///< absent where nothing can touch

  /// Where friction counts motion from.
  const std::vector<double>& moved_from() const { return origins.empty() ? start : origins; }

  /// Elasticity and anchors.
  std::vector<Potential*> elastic_potentials();

  /// L of elasticity and anchors.
  elastic::ConstantForm constant_form() const;

  /// A = M/h^2 + L over the cloths' free vertices, factored.
  std::shared_ptr<const projective::ConstantMatrix> constant_matrix() const;

  /// A sum of potentials over the cloths' vertices, without contact.
  solver::Objective objective(Proximity& inertia,
                              std::vector<Potential*> others,
                              solver::AssemblyCache& assemblies);

  /// All points, with these rows and everything prescribed at its targets.
  std::vector<double> at(const double* rows) const;

  /// All points, with these cloth positions, free coordinates at their targets t, and everything
  /// prescribed at its own.
  std::vector<double> predicted(const double* cloth_positions) const;
};

/// Hessian of inertia, elasticity and anchors at x, all points.
linalg::BlockMatrix contact_free_hessian(Problem& problem, const double* x, Curvature curvature);

/// Spread a parameter given as one value, one a cloth or one a face (owner) over all faces.
std::vector<double> spread(const View& view, const std::vector<Index>& owner);

/// Adjoint of spread(): out += the sums, in order.
void gather(const std::vector<double>& bar,
            const std::vector<Index>& owner,
            View view,
            double* out);

}  // namespace diffcloth::step
