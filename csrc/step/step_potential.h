#pragma once

#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "potential/potential.h"
#include "step/inputs.h"

namespace diffcloth::step {

class Cotangents;
class Problem;
class Tangents;

/// A potential of the cloths that every step minimizes, and its dependence on the step's inputs.
/// Potentials are made from a Problem; step/potentials/make_potentials.cpp lists all of them.
class StepPotential {
 public:
  StepPotential() = default;
  virtual ~StepPotential() = default;
  StepPotential(const StepPotential&) = delete;
  StepPotential& operator=(const StepPotential&) = delete;

  virtual Potential& potential() = 0;

  /// Pull the accumulated cotangents of the potential back: to the gradients of its own inputs, and to
  /// the cotangents of shared quantities: positions at the start, masses and the rest shape.
  virtual void pull_back(const Problem& problem, Cotangents& bars, const Gradients& gradients) = 0;

  /// Set the tangents of the potential's inputs, for add_tangent(): pull_back(), transposed.
  virtual void push_forward(const Problem& problem, const Tangents& tangents) = 0;

  /// Call visit(name, value) for every part of the stored energy at x [J].
  using VisitEnergy = std::function<void(const char* name, double value)>;
  virtual void visit_energy(const double* /*x*/, const VisitEnergy& /*visit*/) const {}

  /// Add the derivatives of the sum of seed(name) times each of these parts: by x to x_bar, and by the
  /// potential's own inputs to the cotangents that pull_back() reads. A class that overrides
  /// visit_energy() must override this function as well.
  using Seed = std::function<double(const char* name)>;
  virtual void accumulate_energy(const double* x, const Seed& /*seed*/, double* /*x_bar*/) {
    visit_energy(x, [](const char* name, double /*value*/) {
      throw std::logic_error(std::string("step: no derivative of the energy ") + name);
    });
  }
};

/// Every potential of the cloths but inertia and contact, in the order of all sums.
///
/// @param problem  its inputs, masses, rest shape, start and model are complete
/// @param wanted   requested gradients; null: none
std::vector<std::unique_ptr<StepPotential>> make_potentials(const Problem& problem,
                                                            const Gradients* wanted);

}  // namespace diffcloth::step
