// The adjoint of dry frictional contact at nodes, in the terms of nodal/system.cpp.
//
// For the cotangent g_x of x, let lambda = Z lambda solve  K^T lambda = Z (g_x + H eta), with eta the
// cotangents of the forces g at nodes, which act on cloths, bodies and pins. Then z = L^T lambda - eta
// is pulled back through the potentials as in schemes/contact_adjoint.cpp. The cotangent of
// E (x - x_n) - h s v_out  at fixed g is minus
//
//   q = (I - P) E (g_x - H z)  +  F lambda            (the first term without P in a sticking contact)
//
// and the cotangents of the frame are
//
//   n_bar  = (n . E g) lambda_E + mu (t . lambda_E) E g - (n . q) h s u,     v_bar = h s q,
//   mu_bar = (n . E g) (t . lambda_E).

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "solver/linear_system.h"
#include "step/nodal/stage.h"
#include "step/nodal/system.h"

namespace diffcloth::step {

using Array = std::vector<double>;
using projective::ContactCase;
using projective::Coulomb;
using projective::NodalContact;

namespace {

/// Cotangents that the forces pull back: E^T E g at nodes; minus E g at bodies, shared by the corners of
/// the nearest faces; g at pins.
struct ForcesBar {
  Array eta;                            ///< cotangents at the rows
  std::vector<Vec3> surface_point_bar;  ///< cotangent of each contact
  bool any;                             ///< true if any of these is not zero
};

ForcesBar pull_back_forces(const Problem& problem,
                           const NodalContacts& contacts,
                           const NodalSystem::Point& at,
                           std::size_t size,
                           const Cotangents& bars) {
  const auto is_zero = [](const Array& bar) {
    return std::ranges::all_of(bar, [](double value) { return value == 0.0; });
  };
  ForcesBar result{.eta = Array(size, 0.0),
                   .surface_point_bar = std::vector<Vec3>(contacts.list.size(), Vec3::Zero()),
                   .any = !is_zero(bars.body_forces) || !is_zero(bars.contact_forces) ||
                          !is_zero(bars.pin_forces)};
  const std::vector<Index>& pins = problem.scene.given.pins;
  for (std::size_t p = 0; p < pins.size(); ++p) {
    Eigen::Map<Vec3>(result.eta.data() + 3 * pins[p]) +=
        row(bars.pin_forces.data(), static_cast<Index>(p));
  }
  for (std::size_t k = 0; result.any && k < contacts.list.size(); ++k) {
    const NodalContact& c = contacts.list[k];
    if (at.laws[k].kind == ContactCase::kTakingOff) continue;
    spread(c, relative(c, bars.contact_forces.data()), result.eta.data());
    if (c.obstacle < 0) continue;
    const Index body = contacts.obstacles[c.obstacle].body;
    const auto share = problem.scene.face_search[body].share(c.surface_point);
    const Vec3 force = relative(c, at.g.data());
    Vec3 weights_bar;
    for (int a = 0; a < 3; ++a) {
      const Vec3 bar = row(bars.body_forces.data(), share.corners[a]);
      spread(c, -share.weights[a] * bar, result.eta.data());
      weights_bar[a] = -bar.dot(force);
    }
    result.surface_point_bar[k] = share.weights_by_point.transpose() * weights_bar;
  }
  return result;
}

/// The cotangent of the normal of a slipping contact; the cotangent of its friction is added to `bars`.
Vec3 pull_back_slipping(const Problem& problem,
                        const NodalContacts& contacts,
                        const NodalSystem::Point& at,
                        std::size_t k,
                        const Vec3& lambda_e,
                        const Vec3& q_held,
                        Cotangents& bars) {
  const NodalContact& c = contacts.list[k];
  const Vec3 force = relative(c, at.g.data());
  const double normal_force = c.normal.dot(force);
  const double along = at.laws[k].direction.dot(lambda_e);
  const double friction_bar = normal_force * along;
  for (const std::size_t entry : friction_entries(problem, contacts, c)) {
    bars.contact.friction[entry] += 0.5 * friction_bar;
  }
  return normal_force * lambda_e + c.friction * along * force -
         c.normal.dot(q_held) * (problem.h * scale(c)) * at.u[k];
}

/// Cotangents of the poses of obstacles: a contact depends on poses as well as on the vertices of its
/// body.
struct PoseCotangents {
  Array start;  ///< [7 T]
  Array end;    ///< [7 T]

  void pull_back(const Gradients& gradients) const {
    add_to(gradients[Input::kBodyPoses], start);
    add_to(gradients[Input::kBodyTargets], end);
  }
};

/// Pull back to the contacts' frames, and to the positions and poses on which the frames depend.
void pull_back_frames(Problem& problem,
                      const NodalContacts& contacts,
                      const NodalSystem& system,
                      const NodalSystem::Point& at,
                      const Array& lambda,
                      const Array& q,
                      const std::vector<Vec3>& surface_point_bar,
                      Cotangents& bars) {
  const projective::Swept cloths = swept(problem);
  PoseCotangents poses{.start = Array(problem.inputs[Input::kBodyPoses].count, 0.0),
                       .end = Array(problem.inputs[Input::kBodyTargets].count, 0.0)};
  for (std::size_t k = 0; k < contacts.list.size(); ++k) {
    const NodalContact& c = contacts.list[k];
    const Coulomb& law = at.laws[k];
    if (law.kind == ContactCase::kTakingOff) continue;
    const double h_s = problem.h * scale(c);
    const Vec3 lambda_e = relative(c, lambda.data());
    const Vec3 q_held = NodalSystem::held(c, law, relative(c, q.data()));
    const Vec3 q_e = q_held + system.turning(c, law, lambda_e);
    spread(c, q_e, bars.start.data());
    Vec3 normal_bar = Vec3::Zero();
    if (law.kind == ContactCase::kSlipping) {
      normal_bar = pull_back_slipping(problem, contacts, at, k, lambda_e, q_held, bars);
    }
    const projective::FrameBar frame = projective::pull_back(
        c, cloths, contacts.obstacles, normal_bar, h_s * q_e, surface_point_bar[k]);
    const auto add_vertex = [&](Index i, const Vec3& bar) {
      Eigen::Map<Vec3>(bars.start.data() + 3 * i) += (1.0 - c.fraction) * bar;
      Eigen::Map<Vec3>(problem.inertia.target_bar.data() + 3 * i) += c.fraction * bar;
    };
    add_vertex(c.vertex, frame.vertex);
    if (c.partner >= 0) {
      add_vertex(c.partner, frame.partner);
    } else {
      const Index pose = problem.scene.given.bodies.pose[contacts.obstacles[c.obstacle].body];
      Eigen::Map<bodies::Pose>(poses.start.data() + 7 * pose) += frame.start;
      Eigen::Map<bodies::Pose>(poses.end.data() + 7 * pose) += frame.end;
    }
  }
  bars.of_stages.emplace_back(
      [poses = std::move(poses)](const Gradients& gradients) { poses.pull_back(gradients); });
}

}  // namespace

void NodalStage::backward(const Backward& step,
                          const Array& x,
                          solver::Factor factor,
                          const Array& g,
                          Cotangents& bars) const {
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  solver::LinearSystem linear(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  const linalg::BlockMatrix H = linear.assemble(x.data(), Curvature::kExact, at.g);
  factor = certified(system, linear, at, H, std::move(factor));

  const ForcesBar forces = pull_back_forces(problem_, contacts_, at, f.coordinates->size(), bars);
  Array b = g;
  system.clear_fixed(b);
  if (forces.any) {
    const Array change = system.hessian_product(at, forces.eta);
    for (std::size_t a = 0; a < b.size(); ++a) b[a] += change[a];
  }
  system.project(at, b);
  const Array lambda = solve_derivative(system, at, H, *factor, true, b);

  Array z = lambda;
  system.couple_transposed(at, z);
  for (std::size_t a = 0; a < z.size(); ++a) z[a] -= forces.eta[a];
  Array z_points(x.size(), 0.0);
  f.coordinates->add_rows(z, z_points);
  Array change = system.hessian_product(at, z);
  for (std::size_t a = 0; a < change.size(); ++a) change[a] = g[a] - change[a];
  Array q(x.size(), 0.0);
  f.coordinates->add_rows(change, q);
  for (Index i = 0; i < f.coordinates->point_count(); ++i) {
    if (f.coordinates->prescribed()[i] == 0) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) bars.ends[a] += q[a];
  }
  f.for_each([&](Potential& p) { p.accumulate(x.data(), z_points.data()); });
  pull_back_frames(problem_, contacts_, system, at, lambda, q, forces.surface_point_bar, bars);
}

}  // namespace diffcloth::step
