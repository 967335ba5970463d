// The tangent of dry frictional contact at nodes, in the terms of nodal/system.cpp.
//
// The held part of the change of x follows from  E (x - x_n) = h s v_out  there: with the tangents of
// all quantities on which the frame depends,
//
//   a = E x_n' + h s v_out',   d = E^T a when sticking,   d = E^T n (n . a - h s n' . u) when slipping,
//
// and d is given at pins. The free part w = Z w solves  K w = -Z b,
//
//   b = L (H d + d/d(theta) g theta') - E^T (F_E a + (n . E g) n' + (mu' (n . E g) + mu n' . E g) t),
//
// F_E being k (P - t t^T) for slipping contacts. Then x' = d + w, and g' = H x' + d/d(theta) g theta'.

#include <algorithm>
#include <utility>

#include "solver/linear_system.h"
#include "step/nodal/stage.h"
#include "step/nodal/system.h"

namespace diffcloth::step {

using Array = std::vector<double>;
using projective::ContactCase;
using projective::Coulomb;
using projective::FrameTangent;
using projective::NodalContact;

namespace {

/// Tangents of the frames of all contacts.
std::vector<FrameTangent> push_forward_frames(const Problem& problem,
                                              const NodalContacts& contacts,
                                              const Tangents& tangents) {
  const projective::Swept cloths = swept(problem);
  const auto pose_change = [&](Input input, const NodalContact& c) -> bodies::Pose {
    const double* const change = tangents.directions.data(input);
    if (change == nullptr) return bodies::Pose::Zero();
    const Index pose = problem.scene.given.bodies.pose[contacts.obstacles[c.obstacle].body];
    return Eigen::Map<const bodies::Pose>(change + 7 * pose);
  };
  std::vector<FrameTangent> result;
  for (const NodalContact& c : contacts.list) {
    const auto at_fraction = [&](Index i) -> Vec3 {
      return (1.0 - c.fraction) * row(tangents.start.data(), i) +
             c.fraction * row(tangents.prediction.data(), i);
    };
    projective::FrameBar dot;
    dot.vertex = at_fraction(c.vertex);
    if (c.partner >= 0) {
      dot.partner = at_fraction(c.partner);
    } else {
      dot.start = pose_change(Input::kBodyPoses, c);
      dot.end = pose_change(Input::kBodyTargets, c);
    }
    result.push_back(projective::push_forward(c, cloths, contacts.obstacles, dot));
  }
  return result;
}

/// Tangent of the equations of a slipping contact by its frame and its friction, at fixed g.
Vec3 slipping_tangent(const NodalContact& c,
                      const Coulomb& law,
                      const Vec3& force,
                      const Vec3& normal_dot,
                      double friction_dot) {
  const double normal_force = c.normal.dot(force);
  return normal_force * normal_dot +
         (friction_dot * normal_force + c.friction * normal_dot.dot(force)) * law.direction;
}

double friction_tangent(const Problem& problem,
                        const NodalContacts& contacts,
                        const NodalContact& c,
                        const Tangents& tangents) {
  double sum = 0.0;
  for (const std::size_t entry : friction_entries(problem, contacts, c)) {
    sum += 0.5 * tangents.contact.friction[entry];
  }
  return sum;
}

/// Add the change of the forces, from the change of the gradient of the rows.
void add_force_tangents(const Problem& problem,
                        const NodalContacts& contacts,
                        const NodalSystem::Point& at,
                        const std::vector<FrameTangent>& frames,
                        const Array& change,
                        const Forces& forces) {
  double* out = forces.pins;
  for (const Index i : problem.scene.given.pins) {
    for (Index a = 3 * i; a < 3 * i + 3; ++a) *out++ += change[a];
  }
  for (std::size_t k = 0; k < contacts.list.size(); ++k) {
    const NodalContact& c = contacts.list[k];
    if (at.laws[k].kind == ContactCase::kTakingOff) continue;
    const Vec3 force = relative(c, at.g.data());
    const Vec3 force_dot = relative(c, change.data());
    spread(c, force_dot, forces.contact);
    if (c.obstacle < 0) continue;
    const Index body = contacts.obstacles[c.obstacle].body;
    const auto share = problem.scene.face_search[body].share(c.surface_point);
    const Vec3 weights_dot = share.weights_by_point * frames[k].surface_point;
    for (int a = 0; a < 3; ++a) {
      Eigen::Map<Vec3>(forces.bodies + 3 * share.corners[a]) -=
          share.weights[a] * force_dot + weights_dot[a] * force;
    }
  }
}

}  // namespace

Array NodalStage::tangent(const Pushforward& step,
                          const Array& x,
                          solver::Factor factor,
                          std::size_t direction) const {
  const Tangents& tangents = step.directions[direction];
  const solver::Objective f = objective();
  const NodalSystem system(problem_, contacts_, f);
  solver::LinearSystem linear(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  const linalg::BlockMatrix H = linear.assemble(x.data(), Curvature::kExact, at.g);
  factor = certified(system, linear, at, H, std::move(factor));
  const std::vector<FrameTangent> frames = push_forward_frames(problem_, contacts_, tangents);

  // Prescribed points, and the parts that contacts hold.
  Array d;
  f.coordinates->take_rows(tangents.ends, d);
  Array law_change(d.size(), 0.0);
  for (std::size_t k = 0; k < contacts_.list.size(); ++k) {
    const NodalContact& c = contacts_.list[k];
    const Coulomb& law = at.laws[k];
    const double h_s = problem_.h * scale(c);
    const Vec3 a = relative(c, tangents.start.data()) + h_s * frames[k].velocity;
    Vec3 held = NodalSystem::held(c, law, a);
    if (law.kind == ContactCase::kSlipping) {
      held -= h_s * frames[k].normal.dot(at.u[k]) * c.normal;
      const double friction_dot = friction_tangent(problem_, contacts_, c, tangents);
      const Vec3 force = relative(c, at.g.data());
      spread(c, slipping_tangent(c, law, force, frames[k].normal, friction_dot), law_change.data());
      spread(c, system.turning(c, law, a), law_change.data());
    }
    spread(c, held, d.data());
  }
  Array theta(x.size(), 0.0);
  f.for_each([&](const Potential& p) { p.add_tangent(x.data(), theta.data()); });
  Array theta_rows;
  f.coordinates->take_rows(theta, theta_rows);
  const auto gradient_change = [&](const Array& rows) {
    Array change = system.hessian_product(at, rows);
    for (std::size_t a = 0; a < change.size(); ++a) change[a] += theta_rows[a];
    return change;
  };
  Array b = gradient_change(d);
  system.couple(at, b);
  for (std::size_t a = 0; a < b.size(); ++a) b[a] = law_change[a] - b[a];
  system.project(at, b);
  Array dz = solve_derivative(system, at, H, *factor, false, b);
  for (std::size_t a = 0; a < dz.size(); ++a) dz[a] += d[a];

  add_force_tangents(problem_, contacts_, at, frames, gradient_change(dz), step.forces[direction]);
  Array dx = tangents.ends;
  f.coordinates->put_rows(dz.data(), dx);
  f.coordinates->carry(x, dx);
  return dx;
}

}  // namespace diffcloth::step
