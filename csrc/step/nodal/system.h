#pragma once

#include <array>
#include <vector>

#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"
#include "linalg/gmres.h"
#include "projective/coulomb.h"
#include "projective/nodal_contact.h"
#include "solver/linear_system.h"
#include "solver/objective.h"
#include "step/nodal/contacts.h"
#include "step/problem.h"

namespace diffcloth::step {

/// s of a contact: see nodal/system.cpp.
double scale(const projective::NodalContact& contact);

/// E v.
Vec3 relative(const projective::NodalContact& contact, const double* v);

/// v += E^T e.
void spread(const projective::NodalContact& contact, const Vec3& e, double* v);

/// The mass of the vertex of a contact, or the reduced mass of its two vertices.
double reduced(const std::vector<double>& masses, const projective::NodalContact& contact);

/// The equations of a stage at one point.
class NodalSystem {
 public:
  /// @param f  inertia, elasticity and anchors, and the couplings of the contacts
  NodalSystem(const Problem& problem, const NodalContacts& contacts, const solver::Objective& f)
      : f_(f),
        p_(problem),
        contacts_(contacts.list),
        partner_(contacts.partner),
        inertia_(contacts.inertia),
        inv_h_sq_(1.0 / (p_.h * p_.h)) {}

  /// The equations at a point.
  struct Point {
    std::vector<double> x;
    std::vector<double> g;  ///< gradient at all points
    std::vector<projective::Coulomb> laws;
    std::vector<Vec3> u;  ///< relative velocities [m/s]
    double merit = 0.0;   ///< sum of |residual|^2 / rho [J]
  };

  void look(Point& at) const;

  double rho(const projective::NodalContact& c) const { return reduced(inertia_, c); }

  Vec3 velocity(const projective::NodalContact& c, const std::vector<double>& x) const;

  /// The part of e that this case of the law holds: I - P, or all, or nothing.
  static Vec3 held(const projective::NodalContact& c,
                   const projective::Coulomb& law,
                   const Vec3& e);

  /// k (P - t t^T) e.
  Vec3 turning(const projective::NodalContact& c,
               const projective::Coulomb& law,
               const Vec3& e) const;

  /// v = Z v, zero at fixed rows.
  void project(const Point& at, std::vector<double>& v) const;

  void clear_fixed(std::vector<double>& v) const;

  /// H v at all rows. Rows of fixed points have elasticity alone: see linalg/block_matrix.h.
  std::vector<double> hessian_product(const Point& at, const std::vector<double>& v) const;

  /// v = L v.
  void couple(const Point& at, std::vector<double>& v) const;

  /// v = L^T v for v = Z v.
  void couple_transposed(const Point& at, std::vector<double>& v) const;

  /// y += F v.
  void add_turning(const Point& at, const std::vector<double>& v, std::vector<double>& y) const;

  /// S in place of H.
  linalg::BlockMatrix without_coupling(const Point& at, const linalg::BlockMatrix& H) const;

  /// Solve K w = b, or K^T w = b, for b = Z b.
  linalg::GmresOutcome solve(const Point& at,
                             const linalg::BlockMatrix& H,
                             const linalg::CholeskyFactor& S,
                             bool transposed,
                             const std::vector<double>& b,
                             double tolerance,
                             std::vector<double>& w) const;

  /// The step that brings the held parts to their values.
  std::vector<double> constraint_step(const Point& at) const;

  /// Minus the equations at the free parts, and minus their change by the constraints' step d.
  ///
  /// @param frozen  with the current magnitude of friction, independent of changes of the normal forces
  std::vector<double> right_side(const Point& at,
                                 const linalg::BlockMatrix& H,
                                 const std::vector<double>& d,
                                 bool frozen) const;

  /// Move points that approach their obstacle back until they do not; return whether there were any.
  bool clear_approach(std::vector<double>& x) const;

  /// A change of the rows, and the impulses during it [N s].
  struct Linearized {
    std::vector<double> p;
    std::vector<Vec3> impulses;
  };

  /// Solve the law of all contacts at once, with forces g + H p for a change p of the rows. For m
  /// contacts, this needs 72 m^2 bytes and 3 m solves with H.
  Linearized solve_linearized(const Point& at, const linalg::CholeskyFactor& H) const;

  /// Change from one point to another of the energy with friction as large as impulses [N s] allow.
  double frozen_energy_change(const Point& at,
                              const std::vector<Vec3>& impulses,
                              const std::vector<double>& to) const;

 private:
  const solver::Objective& f_;
  const Problem& p_;
  const std::vector<projective::NodalContact>& contacts_;
  const std::vector<Index>& partner_;
  const std::vector<double>& inertia_;
  double inv_h_sq_;
};

/// K^-1 b, or K^-T b, to rounding.
///
/// @throws std::domain_error if rounding leaves too large a residual
std::vector<double> solve_derivative(const NodalSystem& system,
                                     const NodalSystem::Point& at,
                                     const linalg::BlockMatrix& H,
                                     const linalg::CholeskyFactor& S,
                                     bool transposed,
                                     const std::vector<double>& b);

/// The factor of S at a solution, recomputed if evicted.
///
/// @throws std::domain_error if the solution is no minimum
solver::Factor certified(const NodalSystem& system,
                         solver::LinearSystem& linear,
                         const NodalSystem::Point& at,
                         const linalg::BlockMatrix& H,
                         solver::Factor factor);

/// Indices of a contact's two surfaces among the coefficients of friction of all pairs, in both orders.
std::array<std::size_t, 2> friction_entries(const Problem& problem,
                                            const NodalContacts& contacts,
                                            const projective::NodalContact& contact);

}  // namespace diffcloth::step
