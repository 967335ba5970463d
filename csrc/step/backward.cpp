// The adjoint of a step.
//
// Let E_k be the objective of friction iteration k = 1..K, x_k its minimizer over the free vertices,
// and grad the gradient over *all* vertices: free, pinned and bodies'. The outputs are x_K,
// v = (x_K - x_n)/h and the forces f_o = -grad_o E_K at fixed x_K (bodies' rows). For cotangents
// x_bar, v_bar, f_bar:
//
//   g_K   = x_bar + v_bar / h
//   z_k   = H_k^-1 (g_k - H_xo f_bar [k = K])      at the free vertices
//   zhat  = (z_k, 0 at pins, f_bar at bodies [k = K, else 0])
//
// Then every input theta that E_k depends on, whether through the solution or through the forces,
// gets the same expression,
//
//   theta_bar -= d/d(theta) ( zhat . grad E_k ),
//
// in particular prescribed positions (pins c, bodies o) get  -(H zhat) at their rows, and pins also
// the direct g_k. Friction's displacement x - x_start gives  x_start_bar += H_D zhat. The lag
// configuration of k is x_{k-1} (x_n for k = 1): its cotangent becomes g_{k-1}, and the sweep goes
// on from K to 1.
//
// `split` adds the elastic stage: the target y of E_k is x^D, and its cotangent is the g of one more
// adjoint of the same form (the paper's Eqs. 8 and 29 with all explicit terms).

#include <algorithm>
#include <stdexcept>

#include "solver/adjoint.h"
#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {
namespace {

using contact::Contact;
using Array = std::vector<double>;

/// Cotangents of what the objectives depend on, before they are pulled back to the inputs.
struct Bars {
  explicit Bars(const Problem& p)
      : all(3 * static_cast<std::size_t>(p.scene.vertex_count())),
        cloth(3 * p.masses.size()),
        start(all, 0.0),
        ends(all, 0.0),
        velocities(cloth, 0.0),
        target(cloth, 0.0),
        metric(p.masses.size(), 0.0),
        masses(p.masses.size(), 0.0),
        anchor_stiffness(p.anchor_stiffness.size(), 0.0),
        anchor_target(3 * p.anchor_stiffness.size(), 0.0),
        elastic(p.scene.topology, p.scene.stencils),
        contact(p.scene.collision_mesh) {}

  std::size_t all, cloth;
  Array start;       ///< x_n and o_n
  Array ends;        ///< pins' targets and o_{n+1}
  Array velocities;  ///< v_n
  Array target;      ///< y of the stage at hand
  Array metric;      ///< G of the stage at hand
  Array masses;
  Array anchor_stiffness, anchor_target;  ///< of zhat . grad, sign not yet turned
  elastic::Bar elastic;                   ///< likewise
  contact::ContactModel::Bar contact;     ///< sign turned
};

/// Which inputs want a gradient beyond the state's.
bool wants_rest(const Gradients& gradients) { return gradients[Input::kRestPositions] != nullptr; }

class Adjoint {
 public:
  Adjoint(const Problem& problem,
          const ConstTape& tape,
          const Gradients& gradients,
          FactorCache& factors)
      : p_(problem),
        tape_(tape),
        gradients_(gradients),
        factors_(factors.find(*tape.key)),
        bars_(problem) {}

  void run(const Cotangents& cotangents, const Checkpoint& checkpoint);

 private:
  std::shared_ptr<const linalg::CholeskyFactor> factor(const solver::Objective& f,
                                                       std::size_t index,
                                                       const double* factored_at);
  void sweep_contact(Array g, const Array& force_bar, const Checkpoint& checkpoint);
  void sweep_elastic_stage();
  Array solve(const solver::Objective& f,
              const Array& x,
              const std::vector<Contact>& contacts,
              const linalg::CholeskyFactor& factor,
              const Array& g,
              const Array* force_bar);
  void accumulate(const solver::Objective& f,
                  const Array& x,
                  const std::vector<Contact>& contacts,
                  const Array& g,
                  const Array& zhat);
  void add_predicted();
  void add_metric();
  void write();
  void write_surfaces();
  void write_materials();
  void write_rest();

  const Problem& p_;
  const ConstTape& tape_;
  const Gradients& gradients_;
  FactorCache::Factors factors_;
  contact::BroadPhase::Scratch scratch_;
  Bars bars_;
};

std::shared_ptr<const linalg::CholeskyFactor> Adjoint::factor(const solver::Objective& f,
                                                              std::size_t index,
                                                              const double* factored_at) {
  if (index < factors_.size() && factors_[index]) return factors_[index];
  const Array x = p_.with_bodies_at_end(factored_at);
  auto result = solver::factor_exact(f, x.data(),
                                     solver::contacts_at(f, x.data(), p_.broad_phase(), &scratch_));
  if (!result) throw std::domain_error("the Hessian is not positive definite at the solution");
  return result;
}

/// zhat of one solve.
Array Adjoint::solve(const solver::Objective& f,
                     const Array& x,
                     const std::vector<Contact>& contacts,
                     const linalg::CholeskyFactor& factor,
                     const Array& g,
                     const Array* force_bar) {
  Array b(bars_.all, 0.0);
  std::copy(g.begin(), g.end(), b.begin());
  Array forces(bars_.all, 0.0);
  if (force_bar != nullptr) {
    std::copy(force_bar->begin(), force_bar->end(),
              forces.begin() + static_cast<std::ptrdiff_t>(bars_.cloth));
    Array coupling;
    f.hessian_product(x.data(), contacts, forces.data(), coupling);
    for (std::size_t a = 0; a < bars_.cloth; ++a) b[a] -= coupling[a];
  }
  Array zhat;
  if (!solver::solve_adjoint(f, x.data(), contacts, factor, b, zhat)) {
    throw std::domain_error("the Hessian is not positive definite at the solution");
  }
  for (std::size_t a = bars_.cloth; a < bars_.all; ++a) zhat[a] = forces[a];
  return zhat;
}

/// All terms of one solve but the lag's: see the head of the file.
void Adjoint::accumulate(const solver::Objective& f,
                         const Array& x,
                         const std::vector<Contact>& contacts,
                         const Array& g,
                         const Array& zhat) {
  Array product;
  f.hessian_product(x.data(), contacts, zhat.data(), product);
  for (const Index i : p_.scene.given.pins) {
    for (Index a = 3 * i; a < 3 * i + 3; ++a) bars_.ends[a] += g[a] - product[a];
  }
  for (std::size_t a = bars_.cloth; a < bars_.all; ++a) bars_.ends[a] -= product[a];

  const double inv_h_sq = 1.0 / (p_.h * p_.h);
  for (std::size_t i = 0; i < f.metric.size(); ++i) {
    const auto v = static_cast<Index>(i);
    const Vec3 z = row(zhat.data(), v);
    Eigen::Map<Vec3>(bars_.target.data() + 3 * i) += f.metric[i] * inv_h_sq * z;
    bars_.metric[i] -= inv_h_sq * z.dot(row(x.data(), v) - row(f.target.data(), v));
  }
  if (f.elastic != nullptr) {
    elastic::add_mixed(*f.elastic, x.data(), zhat.data(), wants_rest(gradients_), bars_.elastic);
  }
  if (f.anchors != nullptr) {
    elastic::add_mixed(*f.anchors, x.data(), zhat.data(), bars_.anchor_stiffness.data(),
                       bars_.anchor_target.data());
  }
  if (f.contact != nullptr) {
    f.contact->add_mixed(contacts, x.data(), zhat.data(), -1.0, bars_.contact);
  }
  if (!f.friction.empty()) {
    f.friction.add_hessian_product(f.x_start, x.data(), zhat.data(), bars_.start.data());
  }
}

void Adjoint::sweep_contact(Array g, const Array& force_bar, const Checkpoint& checkpoint) {
  solver::Objective f = p_.main_objective(tape_.elastic);
  const auto solves = static_cast<std::size_t>(*tape_.solves);
  const std::size_t first_factor = p_.split() ? 1 : 0;
  for (std::size_t k = solves; k-- > 0;) {
    checkpoint.check();
    const Array x = p_.with_bodies_at_end(tape_.iterates + k * bars_.cloth);
    const Array x_lag =
        k == 0 ? p_.start : p_.with_bodies_at_end(tape_.iterates + (k - 1) * bars_.cloth);
    if (f.contact != nullptr) {
      f.friction = contact::FrictionSet(
          *f.contact, solver::contacts_at(f, x_lag.data(), p_.broad_phase(), &scratch_));
    }
    const std::vector<Contact> contacts =
        solver::contacts_at(f, x.data(), p_.broad_phase(), &scratch_);
    const auto preconditioner = factor(f, first_factor + k, tape_.factored + k * bars_.cloth);
    const Array zhat =
        solve(f, x, contacts, *preconditioner, g, k + 1 == solves ? &force_bar : nullptr);
    accumulate(f, x, contacts, g, zhat);

    Array lag_bar(bars_.all, 0.0);
    f.friction.add_mixed(f.x_start, x.data(), zhat.data(), x_lag.data(), -1.0, bars_.contact,
                         lag_bar.data());
    if (k == 0) {
      for (std::size_t a = 0; a < bars_.all; ++a) bars_.start[a] += lag_bar[a];
    } else {
      for (std::size_t a = bars_.cloth; a < bars_.all; ++a) bars_.ends[a] += lag_bar[a];
      g.assign(lag_bar.begin(), lag_bar.begin() + static_cast<std::ptrdiff_t>(bars_.cloth));
    }
  }
}

/// y = xhat = x_n + h v_n + h^2 (gravity + f / m): pull target_bar back.
void Adjoint::add_predicted() {
  const double h = p_.h;
  double* gravity = gradients_[Input::kGravity];
  double* forces = gradients_[Input::kForces];
  for (std::size_t i = 0; i < p_.masses.size(); ++i) {
    const auto v = static_cast<Index>(i);
    const Vec3 y_bar = row(bars_.target.data(), v);
    Eigen::Map<Vec3>(bars_.start.data() + 3 * i) += y_bar;
    Eigen::Map<Vec3>(bars_.velocities.data() + 3 * i) += h * y_bar;
    if (gravity != nullptr) Eigen::Map<Vec3>(gravity) += h * h * y_bar;
    const double m = p_.masses[i];
    if (forces != nullptr) Eigen::Map<Vec3>(forces + 3 * i) += h * h / m * y_bar;
    bars_.masses[i] -= h * h / (m * m) * y_bar.dot(row(p_.inputs.data(Input::kForces), v));
  }
}

/// G of the contact stage back to the masses.
void Adjoint::add_metric() {
  if (p_.scene.given.metric == Metric::kMass) {
    for (std::size_t i = 0; i < bars_.masses.size(); ++i) bars_.masses[i] += bars_.metric[i];
  } else {
    double sum = 0.0;
    for (const double bar : bars_.metric) sum += bar;
    for (double& bar : bars_.masses) bar += sum / static_cast<double>(bars_.masses.size());
  }
  std::ranges::fill(bars_.metric, 0.0);
}

void Adjoint::sweep_elastic_stage() {
  add_metric();
  Array g;
  g.swap(bars_.target);  // the contact stage's target is x^D
  bars_.target.assign(bars_.cloth, 0.0);
  const solver::Objective f = p_.elastic_objective();
  const Array x = p_.with_bodies_at_end(tape_.elastic);
  const auto preconditioner = factor(f, 0, tape_.elastic + bars_.cloth);
  const Array zhat = solve(f, x, {}, *preconditioner, g, nullptr);
  accumulate(f, x, {}, g, zhat);
}

void Adjoint::run(const Cotangents& cotangents, const Checkpoint& checkpoint) {
  Array g(bars_.cloth);
  for (std::size_t a = 0; a < bars_.cloth; ++a) {
    g[a] = cotangents.positions[a] + cotangents.velocities[a] / p_.h;
    bars_.start[a] -= cotangents.velocities[a] / p_.h;
  }
  const Array force_bar(cotangents.body_forces, cotangents.body_forces + (bars_.all - bars_.cloth));
  sweep_contact(std::move(g), force_bar, checkpoint);
  if (p_.split()) sweep_elastic_stage();
  for (std::size_t i = 0; i < bars_.masses.size(); ++i) bars_.masses[i] += bars_.metric[i];
  add_predicted();
  for (std::size_t a = 0; a < bars_.cloth; ++a) bars_.start[a] -= bars_.elastic.x_n[a];
  write();
}

void add_to(double* out, const Array& bar, double scale = 1.0) {
  if (out == nullptr) return;
  for (std::size_t a = 0; a < bar.size(); ++a) out[a] += scale * bar[a];
}

void Adjoint::write() {
  if (double* out = gradients_[Input::kPositions]) {
    for (std::size_t a = 0; a < bars_.cloth; ++a) out[a] += bars_.start[a];
  }
  add_to(gradients_[Input::kVelocities], bars_.velocities);
  if (double* out = gradients_[Input::kPinTargets]) {
    for (const Index i : p_.scene.given.pins) {
      for (Index a = 3 * i; a < 3 * i + 3; ++a) *out++ += bars_.ends[a];
    }
  }
  add_to(gradients_[Input::kSoftPinTargets], bars_.anchor_target, -1.0);
  write_surfaces();
  write_materials();
  write_rest();
}

void Adjoint::write_surfaces() {
  const bodies::BodySet& bodies = p_.scene.given.bodies;
  if (double* out = gradients_[Input::kBodyPoses]) {
    bodies.place_vjp(p_.inputs.data(Input::kBodyPoses), bars_.start.data() + bars_.cloth, out);
  }
  if (double* out = gradients_[Input::kBodyTargets]) {
    bodies.place_vjp(p_.inputs.data(Input::kBodyTargets), bars_.ends.data() + bars_.cloth, out);
  }
  if (double* out = gradients_[Input::kBarrierStiffness]) *out += bars_.contact.kappa;
  if (double* out = gradients_[Input::kBarrierDistance]) *out += bars_.contact.d_hat;
  if (double* out = gradients_[Input::kSlipVelocity]) *out += p_.h * bars_.contact.slip;
  add_to(gradients_[Input::kThickness], bars_.contact.thickness);
  if (double* out = gradients_[Input::kFriction]) {
    const bool one = p_.inputs[Input::kFriction].count == 1;
    for (std::size_t k = 0; k < bars_.contact.friction.size(); ++k) {
      out[one ? 0 : k] += bars_.contact.friction[k];
    }
  }
}

void Adjoint::write_materials() {
  const auto write_per_face = [&](Input input, Array bar, double scale) {
    if (gradients_[input] == nullptr) return;
    for (double& value : bar) value *= scale;
    gather(bar, p_.scene.face_cloth, p_.inputs[input], gradients_[input]);
  };
  write_per_face(Input::kStretch, bars_.elastic.stretch, -1.0);
  write_per_face(Input::kBending, bars_.elastic.bending, -1.0);
  write_per_face(Input::kPoisson, bars_.elastic.poisson, -1.0);
  write_per_face(Input::kDamping, bars_.elastic.damping, -1.0);

  const auto& faces = p_.scene.topology.faces;
  Array density_bar(faces.size());
  for (std::size_t f = 0; f < faces.size(); ++f) {
    double sum = 0.0;
    for (const Index i : faces[f]) sum += bars_.masses[i];
    density_bar[f] = sum * p_.rest->area[f] / 3.0;
  }
  write_per_face(Input::kDensity, std::move(density_bar), 1.0);

  if (double* out = gradients_[Input::kPinStiffness]) {
    const bool one = p_.inputs[Input::kPinStiffness].count == 1;
    const std::vector<Index>& soft = p_.scene.given.soft_pins;
    for (std::size_t k = 0; k < soft.size(); ++k) {
      out[one ? 0 : p_.scene.vertex_cloth[soft[k]]] -= bars_.anchor_stiffness[k];
    }
  }
}

/// The rest shape acts through elasticity, masses and the contacts' weights and mollifiers.
void Adjoint::write_rest() {
  double* out = gradients_[Input::kRestPositions];
  if (out == nullptr) return;
  mesh::RestShapeBar& rest = bars_.elastic.rest;
  const auto turn = [](auto& values) {
    for (auto& value : values) value *= -1.0;
  };
  turn(rest.area);
  turn(rest.shape_gradient);
  turn(rest.curvature_operator);
  turn(rest.curvature);
  turn(rest.bending_area);

  const auto& faces = p_.scene.topology.faces;
  for (std::size_t f = 0; f < faces.size(); ++f) {
    double sum = 0.0;
    for (const Index i : faces[f]) sum += bars_.masses[i];
    rest.area[f] += sum * p_.density[f] / 3.0;
  }
  const std::vector<Index>& start = p_.scene.given.cloth_face_start;
  for (Index c = 0; c < p_.scene.cloth_count(); ++c) {
    const double share = bars_.contact.rest.mean_face_area[c] / (start[c + 1] - start[c]);
    for (Index f = start[c]; f < start[c + 1]; ++f) rest.area[f] += share;
  }
  for (std::size_t i = 0; i < rest.vertex_area.size(); ++i) {
    rest.vertex_area[i] += bars_.contact.rest.vertex_area[i];
  }
  for (std::size_t e = 0; e < rest.edge_area.size(); ++e) {
    rest.edge_area[e] += bars_.contact.rest.edge_area[e];
    rest.edge_length_sq[e] += bars_.contact.rest.edge_length_sq[e];
  }
  const double* X = p_.inputs.data(Input::kRestPositions);
  mesh::rest_shape_vjp(p_.scene.topology, p_.scene.stencils,
                       X != nullptr ? X : p_.scene.given.rest_vertices.data(), rest, out);
}

}  // namespace

void backward(const Scene& scene,
              const Inputs& inputs,
              const ConstTape& tape,
              const Cotangents& cotangents,
              const Checkpoint& checkpoint,
              const Gradients& gradients,
              FactorCache& factors) {
  const Problem problem(scene, inputs);
  Adjoint(problem, tape, gradients, factors).run(cotangents, checkpoint);
}

}  // namespace diffcloth::step
