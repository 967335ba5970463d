// The tangent of a step, in the terms of contact_adjoint.cpp.
//
// At the minimizer x_k the gradient vanishes at the rows, J^T grad E_k = 0, and stays zero along a
// direction of the inputs. Let d be the change of all points due to the prescribed ones alone: pins,
// bodies, and vertices of links with prescribed joints and frames, at fixed free coordinates. Then
//
//   dx_k = d - J H_k^-1 (J^T b + C d),   b = H d + d/d(theta) (grad E_k) theta_dot,
//
// with H over all points, H_k the Hessian over the rows, and C d the change of J^T grad E_k with J along
// d. Every potential adds the contribution of its own inputs to b; friction of k = 1..K also the
// contribution of the lag configuration, whose change is dx_{k-1} (the change of the start for k = 1).
// The outputs change by
//
//   dx = dx_K,   dv = (dx - dx_n) / h,   dg = H dx_K + d/d(theta) (grad E_K) theta_dot   at pins,
//
// and forces of contact, on cloths and bodies, by minus the corresponding terms of barrier and friction
// alone; bodies feel attachments as well.

#include <algorithm>
#include <utility>

#include "step/schemes/contact_stage.h"
#include "step/schemes/contact_sum.h"
#include "step/schemes/taken_solves.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Changes of grad E at all points along a direction of the potentials' inputs, at fixed points.
struct GradientTangent {
  Array touching;  ///< change due to barrier and friction
  Array others;    ///< change due to the other potentials
};

std::vector<GradientTangent> gradient_tangents(
    const Pushforward& step,
    const solver::Objective& f,
    const Array& x,
    const std::vector<contact::TouchingPotential*>& touching,
    const SetTangents& set_tangents) {
  std::vector<GradientTangent> result;
  std::vector<double*> of_touching;
  for (std::size_t l = 0; l < step.directions.size(); ++l) {
    result.push_back({.touching = Array(x.size(), 0.0), .others = Array(x.size(), 0.0)});
    of_touching.push_back(result.back().touching.data());
  }
  for (const contact::TouchingPotential* p : touching) p->add_tangents(x.data(), of_touching);
  for (std::size_t l = 0; l < step.directions.size(); ++l) {
    step.context.checkpoint->check();
    set_tangents(l);
    f.for_each([&](const Potential& p) {
      if (std::ranges::find(touching, &p) != touching.end()) return;
      p.add_tangent(x.data(), result[l].others.data());
    });
  }
  return result;
}

/// d: the change of all points due to the prescribed ones, at fixed rows.
Array prescribed_tangent(const Pushforward& step, std::size_t l, const Array& x) {
  Array d = step.directions[l].ends;
  step.problem.coordinates.carry(x, d);
  return d;
}

/// Several vectors, and the destinations of their products.
struct ProductList {
  std::vector<const double*> z;
  std::vector<double*> y;

  void add(const Array& from, Array& to) {
    z.push_back(from.data());
    y.push_back(to.data());
  }
  Products products() const { return {.z = z, .y = y}; }
};

/// y = H d at the free rows, direction by direction; other rows are left undefined.
void products_with_prescribed(const solver::Objective& f,
                              const Array& x,
                              const std::vector<Array>& d,
                              std::vector<Array>& y) {
  ProductList whole;
  ProductList left_out;
  for (std::size_t l = 0; l < d.size(); ++l) {
    y[l].assign(x.size(), 0.0);
    if (is_zero(d[l])) continue;
    Array rows;
    f.coordinates->take_rows(d[l], rows);
    (is_zero(rows) ? left_out : whole).add(d[l], y[l]);
  }
  f.for_each([&](const Potential& p) {
    p.add_hessian_products(x.data(), whole.products());
    p.add_left_out_products(x.data(), Curvature::kExact, left_out.products());
  });
}

/// Add H dx to the changes of the gradient: at all points for barrier and friction, else at held points.
void add_products_with_motion(const solver::Objective& f,
                              const Array& x,
                              const std::vector<Array>& dx,
                              const std::vector<contact::TouchingPotential*>& touching,
                              std::vector<GradientTangent>& changes) {
  ProductList list;
  for (std::size_t l = 0; l < dx.size(); ++l) list.add(dx[l], changes[l].touching);
  for (const Potential* p : touching) p->add_hessian_products(x.data(), list.products());
  f.for_each([&](const Potential& p) {
    if (std::ranges::find(touching, &p) != touching.end()) return;
    for (std::size_t l = 0; l < dx.size(); ++l) {
      p.add_held_product(x.data(), dx[l].data(), changes[l].others.data());
    }
  });
}

/// Add the change of the forces, from the change of the gradient.
void add_force_tangents(const Pushforward& step,
                        const GradientTangent& change,
                        const Forces& forces) {
  const std::size_t cloth = step.problem.cloth_size;
  const std::size_t end = 3 * static_cast<std::size_t>(step.problem.scene.vertex_count());
  for (std::size_t a = 0; a < cloth; ++a) forces.contact[a] -= change.touching[a];
  for (std::size_t a = cloth; a < end; ++a) {
    // Attachments are the only other potential that acts on bodies.
    forces.bodies[a - cloth] -= change.touching[a] + change.others[a];
  }
  double* out = forces.pins;
  for (const Index i : step.problem.scene.given.pins) {
    for (Index a = 3 * i; a < 3 * i + 3; ++a) *out++ += change.touching[a] + change.others[a];
  }
}

}  // namespace

std::vector<Array> push_forward_solve(const Pushforward& step,
                                      const solver::Objective& f,
                                      const Array& x,
                                      solver::Certificate certificate,
                                      bool with_forces,
                                      const std::vector<contact::TouchingPotential*>& touching,
                                      const SetTangents& set_tangents) {
  const solver::Coordinates& coordinates = *f.coordinates;
  solver::LinearSystem system(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  Array gradient;
  certificate = certified(system, f, x, std::move(certificate), gradient);

  const std::size_t count = step.directions.size();
  std::vector<GradientTangent> changes = gradient_tangents(step, f, x, touching, set_tangents);
  std::vector<Array> d;
  d.reserve(count);
  for (std::size_t l = 0; l < count; ++l) d.push_back(prescribed_tangent(step, l, x));
  std::vector<Array> b(count);
  products_with_prescribed(f, x, d, b);
  for (std::size_t l = 0; l < count; ++l) {
    if (coordinates.is_curved()) coordinates.add_change(x, d[l], gradient, b[l]);
    for (std::size_t a = 0; a < x.size(); ++a) {
      b[l][a] += changes[l].others[a] + changes[l].touching[a];
    }
  }
  std::vector<Array> dx;
  system.solve(certificate, b, dx);
  for (std::size_t l = 0; l < count; ++l) {
    for (std::size_t a = 0; a < x.size(); ++a) dx[l][a] += d[l][a];
  }
  if (with_forces) {
    add_products_with_motion(f, x, dx, touching, changes);
    for (std::size_t l = 0; l < count; ++l) add_force_tangents(step, changes[l], step.forces[l]);
  }
  return dx;
}

std::vector<Array> ContactStage::tangent(const Pushforward& step) {
  ContactSum sum(potentials(), step.problem, step.detection, nullptr, nullptr);
  std::vector<Array> dx;  // change of the lag configuration
  for (const Tangents& tangents : step.directions) dx.push_back(tangents.start);
  TakenSolves solves(step, sum, first_factor);
  for (std::size_t k = 0; k < solves.count(); ++k) {
    solves.stand(k);
    sum.set_tangents(step.directions, dx);
    dx = push_forward_solve(step, sum.objective, solves.x(), solves.certificate(),
                            k + 1 == solves.count(), sum.touching(), set_tangents);
  }
  return dx;
}

}  // namespace diffcloth::step
