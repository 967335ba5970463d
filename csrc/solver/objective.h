#pragma once

#include <algorithm>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "bodies/coordinate_potential.h"
#include "contact/contact_potential.h"
#include "potential/potential.h"
#include "potential/proximity.h"
#include "solver/coordinates.h"
#include "solver/pattern_cache.h"

namespace diffcloth::solver {

/// Objective of a solve: a sum of potentials over all points [J].
///
/// The caller owns the potentials. Some have a further role: the metrics of inertia and of the
/// coordinates' potential scale shifts and speeds, and contact detects collisions along motions.
struct Objective {
  Coordinates* coordinates;
  double h;       ///< time step [s]
  double length;  ///< mean edge of the cloths [m]
  Proximity* inertia;
  std::vector<Potential*> others;                ///< all but inertia, friction and contact
  Potential* friction = nullptr;                 ///< null if nothing touched
  contact::ContactPotential* contact = nullptr;  ///< null if nothing can touch
  bodies::CoordinatePotential* chart = nullptr;  ///< potential of free coordinates; may be null
  /// Bodies on which only contact and `chart`, a quadratic form for them, depend.
  std::span<const bodies::Mechanisms::FreeBody> free_bodies;
  PatternCache* patterns;
  linalg::Couplings expected;  ///< couplings beyond the base pattern, sorted: always in pattern()

  /// Couplings of friction alone, valid as long as `friction`; empty until first used.
  mutable std::optional<linalg::Couplings> of_friction;

  /// Last result of pattern(), with the couplings of points as its key.
  struct KnownPattern {
    linalg::Couplings points;
    std::shared_ptr<const AnalyzedPattern> pattern;  ///< null if none is known
  };
  mutable KnownPattern known_pattern;

  void take_friction(Potential* potential) {
    friction = potential;
    of_friction.reset();
    known_pattern.pattern = nullptr;
  }

  /// Every potential in a fixed order.
  template <class Visit>
  void for_each(Visit&& visit) const {
    visit(static_cast<Potential&>(*inertia));
    if (chart != nullptr) visit(static_cast<Potential&>(*chart));
    for (Potential* potential : others) visit(*potential);
    if (friction != nullptr) visit(*friction);
    if (contact != nullptr) visit(static_cast<Potential&>(*contact));
  }

  void stand_at(const double* x) const {
    coordinates->stand_at(x);
    for_each([&](Potential& p) { p.stand_at(x); });
  }

  double energy(const double* x) const {
    double e = 0.0;
    for_each([&](const Potential& p) { e += p.energy(x); });
    return e;
  }

  double energy_change(const double* x, const double* to) const {
    double change = 0.0;
    for_each([&](const Potential& p) { change += p.energy_change(x, to); });
    return change;
  }

  /// The change of energy without friction and contact.
  double energy_change_without_contact(const double* x, const double* to) const {
    double change = inertia->energy_change(x, to);
    if (chart != nullptr) change += chart->energy_change(x, to);
    for (const Potential* p : others) change += p->energy_change(x, to);
    return change;
  }

  void update_duals(const double* x, const double* p, double alpha, const double* to) const {
    for_each([&](Potential& q) { q.update_duals(x, p, alpha, to); });
  }

  /// Largest change of bounded forces along a small change p of all points, as a share of the bound.
  double force_change(const double* x, const double* p) const {
    double change = 0.0;
    for_each([&](const Potential& q) { change = std::max(change, q.force_change(x, p)); });
    return change;
  }

  /// True if a potential has duals at this point, so that the Hessian kPrimalDual differs from the exact
  /// one.
  bool has_duals(const double* x) const {
    bool any = false;
    for_each([&](const Potential& p) { any = any || p.has_duals(x); });
    return any;
  }

  /// Largest fraction of a change of all points that keeps links and limits in bounds.
  double largest_fraction(const std::vector<double>& x, const std::vector<double>& dx) const;

  /// grad P at all points, prescribed ones included.
  void gradient(const double* x, std::vector<double>& g) const {
    g.assign(3 * static_cast<std::size_t>(coordinates->point_count()), 0.0);
    for_each([&](const Potential& p) { p.add_gradient(x, g.data()); });
  }

  /// y = (d^2 P) z over all points, exact.
  void hessian_product(const double* x, const double* z, std::vector<double>& y) const {
    y.assign(3 * static_cast<std::size_t>(coordinates->point_count()), 0.0);
    for_each([&](const Potential& p) { p.add_hessian_product(x, z, y.data()); });
  }

  /// The product at all points but the cloths' free vertices, whose entries have no meaning.
  void held_product(const double* x, const double* z, std::vector<double>& y) const {
    y.assign(3 * static_cast<std::size_t>(coordinates->point_count()), 0.0);
    for_each([&](const Potential& p) { p.add_held_product(x, z, y.data()); });
  }

  /// Metric for shifts of a Hessian, one entry for each number of a row: M / h^2 for vertices, the
  /// diagonal of the coordinates' metric for coordinates.
  std::vector<double> metric() const;

  /// Pattern of the Hessian at the current point. Most iterates have the couplings of the previous one,
  /// and reuse its pattern.
  std::shared_ptr<const AnalyzedPattern> pattern() const;

  /// Replace the expected couplings, given as couplings of points.
  void expect(linalg::Couplings points);
};

}  // namespace diffcloth::solver
