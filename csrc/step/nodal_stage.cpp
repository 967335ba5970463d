// Dry frictional contact at nodes, and its adjoint.
//
// Let g(x) be the gradient of inertia + elasticity + anchors. Contact c acts through a map E with
// orthonormal rows: on a body's obstacle E x = x_i; between vertices E x = (x_i - x_j) / sqrt(2) = s
// (x_i - x_j), s = 1 for obstacles. With the frame of c fixed by x_n, xhat and the poses,
//
//   impulse            r = h s E g(x)          (no other force acts along E: the step's momentum)
//   relative velocity  u = E (x - x_n) / (h s) - v_out,
//
// and (r, u) obey the law of Signorini and Coulomb: r = Phi(r - rho u), see projective/coulomb.h; which
// masses rho > 0 has no influence on the solution, and those of h^2 times the diagonal of the constant
// matrix M / h^2 + L predict its cases well. So the impulses are no unknowns. Elsewhere g = 0. Let P = I - n n^T. The equations along E of each case are
//
//   taking off   E g = 0
//   sticking     u = 0
//   slipping     n . u = 0,   P E g - mu (n . E g) t = 0,   t = -u_T / |u_T|.
//
// Let Z project onto what no constraint holds (E^T P E of slipping nodes, nothing of sticking ones),
// L = Z - sum mu E^T t n^T E, and F = sum k E^T (P - t t^T) E with k = mu r_n / (h^2 s^2 |u_T|): friction
// turns with the slip. With the Hessian H of the energy, a change w = Z w of the free part changes the
// equations by
//
//   K w = L H w + F w.
//
// K is not symmetric, but S = Z H Z + F + (I - Z) rho / h^2 is: the system without the coupling of friction
// and normal force. It has the pattern of H, its Cholesky factor preconditions GMRES, and shows that
// the solution is a minimum where the friction is frozen. Off the solution the same operators, with t and k
// of s = r - rho u, are those of a semismooth Newton method.
//
// Adjoint. For the cotangent g_x of x, let lambda = Z lambda solve  K^T lambda = Z (g_x + H eta), with eta
// those of the forces E g at nodes, which the bodies feel. Then z = L^T lambda - eta goes through the
// potentials as in contact_stage.cpp. The cotangent of E (x - x_n) - h s v_out at fixed g is minus
//
//   q = (I - P) E (g_x - H z)  +  F lambda            (the first term without P where it sticks)
//
// and those of the frame are
//
//   n_bar  = (n . E g) lambda_E + mu (t . lambda_E) E g - (n . q) h s u,     v_bar = h s q,
//   mu_bar = (n . E g) (t . lambda_E).

#include "step/nodal_stage.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <stdexcept>
#include <utility>

#include "elastic/repeated_elasticity.h"
#include "linalg/gmres.h"
#include "projective/anderson.h"
#include "solver/linear_system.h"

namespace diffcloth::step {

using Array = std::vector<double>;
using projective::ContactCase;
using projective::Coulomb;
using projective::NodalContact;
using projective::Obstacle;

namespace {

/// Of a direction of Newton's method: less would not shorten the way.
constexpr double kDirectionTolerance = 1e-4;
/// Of the adjoint, relative.
constexpr double kAdjointTolerance = 1e-12;
/// What rounding may leave of it on a badly conditioned mesh.
constexpr double kLargestAdjointError = 1e-8;
constexpr int kMostProducts = 300;
/// A Newton step must reduce the squared residual by this much; else the energy leads.
constexpr double kContraction = 0.25;
/// As in solver/newton.cpp: a step below this share of the tolerance is not worth taking.
constexpr double kSettled = 0.1;
constexpr int kHalvings = 40;
/// Steps down the energy after which Newton's step is taken whatever it does to the residual: the
/// friction that they freeze may go round in circles.
constexpr int kMostDescents = 3;
/// Newton steps that are taken where no way leads down.
constexpr int kMostIdle = 20;
/// Of the exact Hessian's projection, where that is indefinite: see solver/direction.h.
constexpr double kLeastBlend = 0.1;
constexpr double kMostBlend = 1e12;

/// Couplings of rows of which one is in contact with another vertex: the eliminated unknowns of a pair
/// couple all neighbors of both.
class PairPattern final : public Potential {
 public:
  PairPattern(const linalg::BlockPattern& base,
              const std::vector<Index>& partner,
              const std::vector<char>& prescribed) {
    const auto rows = static_cast<Index>(partner.size());
    for (Index q = 0; q < rows; ++q) {
      for (Index k = base.column_start()[q]; k < base.column_start()[q + 1]; ++k) {
        const Index p = base.row()[k];
        if (p >= rows || (partner[p] < 0 && partner[q] < 0)) continue;
        for (const Index a : {p, partner[p]}) {
          for (const Index b : {q, partner[q]}) {
            if (a < 0 || b < 0 || a == b || prescribed[a] != 0 || prescribed[b] != 0) continue;
            pairs_.emplace_back(std::max(a, b), std::min(a, b));
          }
        }
      }
    }
  }

  double energy(const double* /*x*/) const override { return 0.0; }
  double energy_change(const double* /*x*/, const double* /*to*/) const override { return 0.0; }
  void add_gradient(const double* /*x*/, double* /*g*/) const override {}
  void add_couplings(std::vector<std::pair<Index, Index>>& pairs) const override {
    pairs.insert(pairs.end(), pairs_.begin(), pairs_.end());
  }
  void add_hessian(const double* /*x*/,
                   Curvature /*curvature*/,
                   linalg::BlockMatrix& /*A*/) const override {}
  void add_hessian_product(const double* /*x*/, const double* /*z*/, double* /*y*/) const override {
  }
  void accumulate(const double* /*x*/, const double* /*z*/) override {}

 private:
  std::vector<std::pair<Index, Index>> pairs_;
};

double scale(const NodalContact& c) { return c.partner < 0 ? 1.0 : 1.0 / std::numbers::sqrt2; }

/// E v.
Vec3 relative(const NodalContact& c, const double* v) {
  if (c.partner < 0) return row(v, c.vertex);
  return scale(c) * (row(v, c.vertex) - row(v, c.partner));
}

/// v += E^T e.
void spread(const NodalContact& c, const Vec3& e, double* v) {
  const Vec3 part = scale(c) * e;
  Eigen::Map<Vec3>(v + 3 * c.vertex) += part;
  if (c.partner >= 0) Eigen::Map<Vec3>(v + 3 * c.partner) -= part;
}

/// Of masses of vertices: that of the vertex, or what two of them have against each other.
double reduced(const Array& masses, const NodalContact& c) {
  const double m = masses[c.vertex];
  if (c.partner < 0) return m;
  return m * masses[c.partner] / (m + masses[c.partner]);
}

Vec3 tangential(const Vec3& e, const Vec3& n) { return e - n * n.dot(e); }

double pair_friction(const Problem& p, Index a, Index b) {
  const View mu = p.inputs[Input::kFriction];
  const Index surfaces = p.scene.surface_count();
  if (mu.count == 1) return mu.data[0];
  return 0.5 * (mu.data[a * surfaces + b] + mu.data[b * surfaces + a]);
}

/// Whether two surfaces may touch: the pairs that the user leaves out are left out here too.
bool may_touch(const Problem& p, Index a, Index b) {
  const std::array<Index, 2> pair{std::min(a, b), std::max(a, b)};
  return std::ranges::find(p.scene.given.ignored_pairs, pair) == p.scene.given.ignored_pairs.end();
}

std::vector<Obstacle> make_obstacles(const Problem& p) {
  const Scene& scene = p.scene;
  std::vector<Obstacle> obstacles;
  for (std::size_t k = 0; k < scene.given.primitives.size(); ++k) {
    if (scene.given.primitives[k].kind == projective::PrimitiveKind::kNone) continue;
    const auto body = static_cast<Index>(k);
    const Index surface = scene.cloth_count() + body;
    const std::ptrdiff_t pose = 7 * static_cast<std::ptrdiff_t>(scene.given.bodies.pose[k]);
    Obstacle& o = obstacles.emplace_back();
    o.body = body;
    o.shape = scene.given.primitives[k];
    o.start = Eigen::Map<const bodies::Pose>(p.inputs.data(Input::kBodyPoses) + pose);
    o.end = Eigen::Map<const bodies::Pose>(p.inputs.data(Input::kBodyTargets) + pose);
    const double* thickness = p.inputs.data(Input::kThickness);
    for (Index c = 0; c < scene.cloth_count(); ++c) {
      o.friction.push_back(pair_friction(p, c, surface));
      o.band.push_back(may_touch(p, c, surface) ? 0.5 * (thickness[c] + thickness[surface])
                                                : -std::numeric_limits<double>::infinity());
    }
  }
  return obstacles;
}

projective::Swept swept(const Problem& p) {
  return {.x = p.inputs.data(Input::kPositions),
          .predicted = p.inertia.target().data(),
          .h = p.h,
          .cloth = p.scene.vertex_cloth,
          .prescribed = p.scene.prescribed};
}

/// Spheres around all vertices, half as large as the shortest edge there at rest.
projective::Spheres make_spheres(const Problem& p) {
  const Scene& scene = p.scene;
  const auto n = static_cast<std::size_t>(scene.cloth_vertex_count());
  projective::Spheres spheres;
  spheres.radius.assign(n, std::numeric_limits<double>::infinity());
  spheres.apart.resize(n);
  for (Index e = 0; e < scene.collision_mesh.cloth_edge_count; ++e) {
    const auto& [i, j] = scene.collision_mesh.edges[e];
    const double length =
        (row(scene.given.rest_vertices.data(), i) - row(scene.given.rest_vertices.data(), j))
            .norm();
    for (const auto& [a, b] : {std::pair{i, j}, std::pair{j, i}}) {
      spheres.radius[a] = std::min(spheres.radius[a], 0.5 * length);
      spheres.apart[a].push_back(b);
    }
  }
  for (auto& others : spheres.apart) std::ranges::sort(others);
  for (Index a = 0; a < scene.cloth_count(); ++a) {
    for (Index b = 0; b < scene.cloth_count(); ++b) {
      spheres.friction.push_back(pair_friction(p, a, b));
      const bool touch = may_touch(p, a, b) && (a != b || scene.given.self_contact);
      spheres.touching.push_back(touch ? 1 : 0);
    }
  }
  return spheres;
}

}  // namespace

/// The equations of a stage at one point.
class NodalSystem {
 public:
  NodalSystem(const NodalStage& stage, const solver::Objective& f)
      : f_(f),
        p_(stage.problem_),
        contacts_(stage.contacts_),
        partner_(stage.partner_),
        inertia_(stage.inertia_),
        inv_h_sq_(1.0 / (p_.h * p_.h)) {}

  /// What the equations are at a point.
  struct Point {
    Array x;
    Array g;  ///< of all points
    std::vector<Coulomb> laws;
    std::vector<Vec3> u;  ///< relative velocities [m/s]
    double merit = 0.0;   ///< sum of |residual|^2 / rho [J]
  };

  void look(Point& at) const {
    f_.stand_at(at.x.data());
    f_.gradient(at.x.data(), at.g);
    at.laws.resize(contacts_.size());
    at.u.resize(contacts_.size());
    Array residual(p_.cloth_size);
    for (std::size_t a = 0; a < residual.size(); ++a) residual[a] = p_.h * at.g[a];
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      at.u[k] = velocity(c, at.x);
      const Vec3 r = p_.h * scale(c) * relative(c, at.g.data());
      at.laws[k] = projective::coulomb(r - rho(c) * at.u[k], c.normal, c.friction);
      spread(c, -at.laws[k].impulse / scale(c), residual.data());
    }
    at.merit = 0.0;
    for (std::size_t i = 0; i < p_.masses.size(); ++i) {
      if (p_.scene.prescribed[i] != 0) continue;
      at.merit += row(residual.data(), static_cast<Index>(i)).squaredNorm() / inertia_[i];
    }
  }

  double rho(const NodalContact& c) const { return reduced(inertia_, c); }

  Vec3 velocity(const NodalContact& c, const Array& x) const {
    const Vec3 moved = relative(c, x.data()) - relative(c, p_.start.data());
    return moved / (p_.h * scale(c)) - c.velocity;
  }

  /// What holds along E at this case of the law: I - P, or all, or nothing.
  static Vec3 held(const NodalContact& c, const Coulomb& law, const Vec3& e) {
    switch (law.kind) {
      case ContactCase::kTakingOff:
        return Vec3::Zero();
      case ContactCase::kSticking:
        return e;
      case ContactCase::kSlipping:
        return c.normal * c.normal.dot(e);
    }
    __builtin_unreachable();
  }

  /// k (P - t t^T) e.
  Vec3 turning(const NodalContact& c, const Coulomb& law, const Vec3& e) const {
    if (law.kind != ContactCase::kSlipping) return Vec3::Zero();
    const double k = law.ratio * rho(c) * inv_h_sq_ / (scale(c) * scale(c));
    const Vec3 across = tangential(e, c.normal) - law.direction * law.direction.dot(e);
    return k * across;
  }

  /// v = Z v, zero at fixed rows.
  void project(const Point& at, Array& v) const {
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      spread(c, -held(c, at.laws[k], relative(c, v.data())), v.data());
    }
    clear_fixed(v);
  }

  void clear_fixed(Array& v) const {
    for (Index i = 0; i < f_.coordinates->row_count(); ++i) {
      if (!f_.coordinates->is_free(i)) std::fill_n(v.begin() + 3 * std::ptrdiff_t{i}, 3, 0.0);
    }
  }

  /// v = L v.
  void couple(const Point& at, Array& v) const {
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      const Vec3 e = relative(c, v.data());
      spread(c, -held(c, at.laws[k], e) - c.friction * c.normal.dot(e) * at.laws[k].direction,
             v.data());
    }
    clear_fixed(v);
  }

  /// v = L^T v for v = Z v.
  void couple_transposed(const Point& at, Array& v) const {
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      const Vec3 e = relative(c, v.data());
      spread(c, -c.friction * at.laws[k].direction.dot(e) * c.normal, v.data());
    }
    clear_fixed(v);
  }

  /// y += F v.
  void add_turning(const Point& at, const Array& v, Array& y) const {
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      spread(c, turning(c, at.laws[k], relative(c, v.data())), y.data());
    }
  }

  /// S in place of H.
  linalg::BlockMatrix without_coupling(const Point& at, const linalg::BlockMatrix& H) const;

  /// Solve K w = b, or K^T w = b, for b = Z b.
  linalg::GmresOutcome solve(const Point& at,
                             const linalg::BlockMatrix& H,
                             const linalg::CholeskyFactor& S,
                             bool transposed,
                             const Array& b,
                             double tolerance,
                             Array& w) const {
    Array inner;
    const linalg::LinearMap apply = [&](const Array& v, Array& y) {
      inner = v;
      if (transposed) couple_transposed(at, inner);
      y.assign(v.size(), 0.0);
      H.add_product(inner.data(), y.data());
      if (transposed) {
        project(at, y);
      } else {
        couple(at, y);
      }
      add_turning(at, v, y);
    };
    const linalg::LinearMap precondition = [&](const Array& v, Array& y) {
      y.assign(v.size(), 0.0);
      S.solve(v.data(), y.data());
    };
    return linalg::gmres(apply, precondition, b, tolerance, kMostProducts, w);
  }

  /// What brings the held parts to where they must be.
  Array constraint_step(const Point& at) const {
    Array d(f_.coordinates->size(), 0.0);
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      spread(c, -p_.h * scale(c) * held(c, at.laws[k], at.u[k]), d.data());
    }
    return d;
  }

  /// Minus the equations at the free parts, and minus what the constraints' step d does to them.
  ///
  /// @param frozen  with friction as large as it is now, whatever becomes of the normal forces
  Array right_side(const Point& at,
                   const linalg::BlockMatrix& H,
                   const Array& d,
                   bool frozen) const {
    Array b(at.g.begin(), at.g.begin() + static_cast<std::ptrdiff_t>(p_.cloth_size));
    b.resize(f_.coordinates->size(), 0.0);
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      const Coulomb& law = at.laws[k];
      if (law.kind == ContactCase::kTakingOff) continue;
      const Vec3 e = relative(c, b.data());
      Vec3 equations = Vec3::Zero();
      if (law.kind == ContactCase::kSlipping) {
        const Vec3 e_t = tangential(e, c.normal);
        const double along = law.direction.dot(e);
        const double normal =
            frozen ? law.impulse.dot(c.normal) / (p_.h * scale(c)) : c.normal.dot(e);
        equations = law.direction * (along - c.friction * normal) +
                    (1.0 + law.ratio) * (e_t - law.direction * along);
      }
      spread(c, equations - e, b.data());
    }
    Array change(b.size(), 0.0);
    H.add_product(d.data(), change.data());
    if (frozen) {
      project(at, change);
    } else {
      couple(at, change);
    }
    for (std::size_t a = 0; a < b.size(); ++a) b[a] = -b[a] - change[a];
    clear_fixed(b);
    return b;
  }

  /// Move the points that approach what they touch back to where they do not.
  void clear_approach(Array& x) const {
    for (const NodalContact& c : contacts_) {
      const double approach = std::min(c.normal.dot(velocity(c, x)), 0.0);
      spread(c, -p_.h * scale(c) * approach * c.normal, x.data());
    }
  }

  /// Change from one point to another of the energy with friction as large as at the first.
  double frozen_energy_change(const Point& at, const Array& to) const {
    double change = f_.energy_change(at.x.data(), to.data());
    for (std::size_t k = 0; k < contacts_.size(); ++k) {
      const NodalContact& c = contacts_[k];
      const double limit = c.friction * at.laws[k].impulse.dot(c.normal);
      change += limit * (tangential(velocity(c, to), c.normal).norm() -
                         tangential(at.u[k], c.normal).norm());
    }
    return change;
  }

 private:
  const solver::Objective& f_;
  const Problem& p_;
  const std::vector<NodalContact>& contacts_;
  const std::vector<Index>& partner_;
  const Array& inertia_;
  double inv_h_sq_;
};

linalg::BlockMatrix NodalSystem::without_coupling(const Point& at,
                                                  const linalg::BlockMatrix& H) const {
  // Z_pp and, in pairs, Z_p'p of each vertex p.
  struct Projection {
    Mat3 own;
    Mat3 other;
  };
  const auto n = static_cast<Index>(p_.masses.size());
  std::vector<Index> place(static_cast<std::size_t>(n), -1);
  std::vector<Projection> projections;
  linalg::BlockMatrix S = H;
  const linalg::BlockPattern& pattern = H.pattern();
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    if (at.laws[k].kind == ContactCase::kTakingOff) continue;
    Mat3 I_minus_P = Mat3::Identity();
    if (at.laws[k].kind == ContactCase::kSlipping) I_minus_P = c.normal * c.normal.transpose();
    const double s = scale(c);
    const Mat3 own = Mat3::Identity() - s * s * I_minus_P;
    const Mat3 other = s * s * I_minus_P;
    place[c.vertex] = static_cast<Index>(projections.size());
    projections.push_back({.own = own, .other = other});
    if (c.partner >= 0) {
      place[c.partner] = static_cast<Index>(projections.size());
      projections.push_back({.own = own, .other = other});
    }
  }
  // Blocks that a contact touches leave their place, and come back projected.
  struct Moved {
    Index p, q;
    Mat3 block;
  };
  std::vector<Moved> moved;
  for (Index q = 0; q < n; ++q) {
    for (Index k = pattern.column_start()[q]; k < pattern.column_start()[q + 1]; ++k) {
      const Index p = pattern.row()[k];
      if (p >= n || (place[p] < 0 && place[q] < 0)) continue;
      Eigen::Map<Mat3> block(S.blocks() + 9 * static_cast<std::ptrdiff_t>(k));
      moved.push_back({.p = p, .q = q, .block = block});
      block.setZero();
    }
  }
  // Rows that Z takes a vertex to: itself, and its partner.
  const auto images = [&](Index p) {
    std::array<std::pair<Index, Mat3>, 2> rows{std::pair{p, Mat3(Mat3::Identity())},
                                               std::pair{Index{-1}, Mat3(Mat3::Zero())}};
    if (place[p] < 0) return rows;
    rows[0].second = projections[place[p]].own;
    if (partner_[p] >= 0) rows[1] = {partner_[p], projections[place[p]].other};
    return rows;
  };
  const std::vector<char>& fixed = p_.scene.prescribed;
  for (const Moved& m : moved) {
    for (const auto& [a, Z_a] : images(m.p)) {
      for (const auto& [b, Z_b] : images(m.q)) {
        if (a < 0 || b < 0) continue;
        // Rows of fixed points are no part of the matrix, nor in its pattern beyond the base.
        if ((fixed[a] != 0 || fixed[b] != 0) && (a != m.p || b != m.q)) continue;
        const Mat3 block = Z_a * m.block * Z_b.transpose();
        if (m.p == m.q) {
          if (a >= b) S.add_block(a, b, block);
        } else if (a == b) {
          S.add_block(a, b, block + block.transpose());
        } else if (a > b) {
          S.add_block(a, b, block);
        } else {
          S.add_block(b, a, block.transpose());
        }
      }
    }
  }
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    const Coulomb& law = at.laws[k];
    if (law.kind == ContactCase::kTakingOff) continue;
    Mat3 added;
    const double m = rho(c) * inv_h_sq_ / (scale(c) * scale(c));
    for (int a = 0; a < 3; ++a) {
      const Vec3 axis = Vec3::Unit(a);
      added.col(a) = m * held(c, law, axis) + turning(c, law, axis);
    }
    const double s = scale(c);
    S.add_block(c.vertex, c.vertex, s * s * added);
    if (c.partner >= 0) {
      S.add_block(c.partner, c.partner, s * s * added);
      S.add_block(std::max(c.vertex, c.partner), std::min(c.vertex, c.partner), -s * s * added);
    }
  }
  return S;
}

NodalStage::NodalStage(Problem& problem, bool vertices_touch)
    : problem_(problem), obstacles_(make_obstacles(problem)) {
  const Scene& scene = problem.scene;
  if (problem.inputs.data(Input::kFriction) == nullptr) return;  // nothing can touch
  if (vertices_touch) {
    const projective::Spheres spheres = make_spheres(problem);
    contacts_ = projective::find_contacts(swept(problem), obstacles_, &spheres);
  } else {
    contacts_ = projective::find_contacts(swept(problem), obstacles_, nullptr);
  }
  if (contacts_.empty()) return;
  const elastic::ConstantForm form = problem.constant_form();
  for (std::size_t i = 0; i < problem.masses.size(); ++i) {
    const double stiffness = form.values()[form.pattern().column_start()[i]];
    inertia_.push_back(problem.masses[i] + problem.h * problem.h * stiffness);
  }
  partner_.assign(problem.masses.size(), -1);
  bool pairs = false;
  for (const NodalContact& c : contacts_) {
    if (c.partner < 0) continue;
    partner_[c.vertex] = c.partner;
    partner_[c.partner] = c.vertex;
    pairs = true;
  }
  if (pairs) {
    pattern_ =
        std::make_unique<PairPattern>(scene.elastic_assemblies.base(), partner_, scene.prescribed);
  }
}

namespace {

/// Largest change [m]; infinite where one is not finite.
double largest(const Array& change) {
  double size = 0.0;
  for (const double value : change) {
    if (!std::isfinite(value)) return std::numeric_limits<double>::infinity();
    size = std::max(size, std::abs(value));
  }
  return size;
}

solver::Objective objective(Problem& problem, Potential* pattern) {
  std::vector<Potential*> others = problem.elastic_potentials();
  if (pattern != nullptr) others.push_back(pattern);
  return problem.objective(problem.inertia, std::move(others), problem.scene.elastic_assemblies);
}

}  // namespace

void NodalStage::start(Array& x) const {
  const solver::Objective f = objective(problem_, pattern_.get());
  const NodalSystem system(*this, f);
  for (const NodalContact& c : contacts_) {
    const Vec3 u = system.velocity(c, x);
    const double m = system.rho(c);
    const Vec3 r = projective::coulomb(-m * u, c.normal, c.friction).impulse;
    spread(c, problem_.h * scale(c) / m * r, x.data());
  }
  // Where that would collapse the cloth, where it stands is the better place to begin.
  Array held = problem_.predicted(problem_.start.data());
  system.clear_approach(held);
  if (f.energy(held.data()) < f.energy(x.data())) x = std::move(held);
}

projective::Outcome NodalStage::iterate(const projective::Options& options,
                                        const Checkpoint& checkpoint,
                                        Array& x) const {
  const solver::Objective f = objective(problem_, pattern_.get());
  const NodalSystem system(*this, f);
  const auto matrix = problem_.constant_matrix();
  const elastic::RepeatedElasticity elasticity(problem_.model, problem_.scene.slots,
                                               problem_.scene.elastic_assemblies.base());
  std::vector<const Potential*> potentials{&problem_.inertia, &elasticity};
  if (problem_.anchors) potentials.push_back(&*problem_.anchors);
  projective::ConstantMatrix::Scratch scratch;
  projective::Anderson anderson(problem_.cloth_size);
  projective::Outcome outcome;
  Array g(problem_.cloth_size);
  Array force(problem_.cloth_size);
  Array p(problem_.cloth_size);
  Array q(problem_.cloth_size);
  Array plain(problem_.cloth_size);  // where the last iteration leads without acceleration
  Array to = x;
  double last = std::numeric_limits<double>::infinity();
  bool accelerated = false;
  for (;; ++outcome.iterations) {
    checkpoint.check();
    std::ranges::fill(g, 0.0);
    for (const Potential* potential : potentials) potential->add_gradient(x.data(), g.data());
    force = g;
    for (const NodalContact& c : contacts_) {
      const double h_s = problem_.h * scale(c);
      const Vec3 r = h_s * relative(c, g.data());
      // With the true masses for rho the iteration contracts wherever the cloth is taut.
      const Vec3 s = r - reduced(problem_.masses, c) * system.velocity(c, x);
      spread(c, -projective::coulomb(s, c.normal, c.friction).impulse / h_s, force.data());
    }
    outcome.residual = 0.0;
    for (const Index i : matrix->vertices()) {
      const double rate = problem_.h * row(force.data(), i).norm() / problem_.masses[i];
      if (!std::isfinite(rate)) {
        outcome.status = projective::Status::kOverflow;
        return outcome;
      }
      outcome.residual = std::max(outcome.residual, rate);
    }
    if (outcome.residual < options.tolerance) {
      outcome.status = projective::Status::kConverged;
      return outcome;
    }
    if (outcome.iterations == options.max_iterations) return outcome;
    matrix->solve(force.data(), p.data(), scratch);
    double size = 0.0;
    for (std::size_t a = 0; a < p.size(); ++a) {
      p[a] = -p[a];
      q[a] = -force[a];
      size += p[a] * q[a];
    }
    if (accelerated && size > last) {
      // Acceleration has led astray: go on from where the plain iteration leads.
      anderson = projective::Anderson(problem_.cloth_size);
      std::ranges::copy(plain, x.begin());
      accelerated = false;
      continue;
    }
    last = size;
    for (std::size_t a = 0; a < p.size(); ++a) plain[a] = x[a] + p[a];
    anderson.next(x.data(), p.data(), q.data(), to.data());
    x.swap(to);
    accelerated = true;
  }
}

solver::Outcome NodalStage::solve(solver::Context& context, Array& x) const {
  const solver::Objective f = objective(problem_, pattern_.get());
  const NodalSystem system(*this, f);
  solver::LinearSystem linear(f, *context.workspace, *context.watch, *context.counts);
  const double goal = context.options.tolerance * problem_.h;
  solver::Outcome outcome;
  NodalSystem::Point here;
  NodalSystem::Point there;
  here.x = x;
  system.look(here);
  double blend = 0.0;
  int idle = 0;
  const auto finish = [&](solver::Status status) {
    outcome.status = status;
    x = std::move(here.x);
    return outcome;
  };
  // Where `there` is, by the fraction alpha of a change of the rows.
  const auto go = [&](const Array& p, double alpha) {
    there.x = here.x;
    for (std::size_t a = 0; a < problem_.cloth_size; ++a) there.x[a] += alpha * p[a];
  };
  int descents = 0;  // since Newton's method last had its way
  for (;; ++context.iterations) {
    context.checkpoint->check();
    const linalg::BlockMatrix H = linear.assemble(here.x.data(), Curvature::kExact, here.g);
    solver::Factor factor = linear.factor(system.without_coupling(here, H));
    const Array d = system.constraint_step(here);
    Array p;
    bool solved = false;
    if (factor) {
      const Stopwatch::Scope scope(*context.watch, Phase::kSolve);
      Array b = system.right_side(here, H, d, false);
      system.project(here, b);
      solved = system.solve(here, H, *factor, false, b, kDirectionTolerance, p).converged;
      for (std::size_t a = 0; a < p.size(); ++a) p[a] += d[a];
      const double step = largest(p);
      outcome.residual = step / problem_.h;
      if (solved && step <= kSettled * goal) {
        outcome.factor = factor;
        return finish(solver::Status::kConverged);
      }
      if (solved) {
        go(p, 1.0);
        system.look(there);
        const bool contracts = there.merit <= kContraction * here.merit;
        if (!contracts && step < goal) {  // what is left of the residual is rounding
          outcome.factor = factor;
          return finish(solver::Status::kConverged);
        }
        if (context.iterations >= context.options.max_iterations) {
          return finish(solver::Status::kIterationLimit);
        }
        if (contracts || (descents >= kMostDescents && std::isfinite(there.merit))) {
          descents = 0;
          ++context.counts->exact;
          std::swap(here, there);
          continue;
        }
      }
    } else {
      ++context.counts->negative_curvature;
    }
    if (context.iterations >= context.options.max_iterations) {
      return finish(solver::Status::kIterationLimit);
    }

    // With its friction frozen the step minimizes an energy: go down that one.
    blend = factor ? 0.0 : std::max(kLeastBlend, blend / 4.0);
    if (factor) {
      ++context.counts->exact;
    } else {
      ++context.counts->projected;
      const linalg::BlockMatrix positive =
          linear.assemble(here.x.data(), Curvature::kPositive, here.g);
      for (;; blend *= 4.0) {
        if (!(blend < kMostBlend)) return finish(solver::Status::kRoundingFloor);
        linalg::BlockMatrix damped = H;
        damped.blend(positive, blend);
        factor = linear.factor(system.without_coupling(here, damped));
        if (factor) break;
      }
    }
    const Stopwatch::Scope scope(*context.watch, Phase::kLineSearch);
    Array b = system.right_side(here, H, d, true);
    system.project(here, b);
    Array down(b.size(), 0.0);
    factor->solve(b.data(), down.data());
    for (std::size_t a = 0; a < down.size(); ++a) down[a] += d[a];
    bool moved = false;
    double alpha = 1.0;
    for (int k = 0; k < kHalvings && !moved; ++k, alpha *= 0.5) {
      go(down, alpha);
      system.clear_approach(there.x);
      moved = system.frozen_energy_change(here, there.x) < 0.0;
    }
    ++descents;
    if (!moved) {
      // The cases of the law at hand point nowhere: those behind Newton's step may.
      if (!solved || idle >= kMostIdle) return finish(solver::Status::kRoundingFloor);
      ++idle;
      go(p, 1.0);
    }
    system.look(there);
    std::swap(here, there);
  }
}

void NodalStage::finish(const Array& x, Report& report, double* body_forces) const {
  const solver::Objective f = objective(problem_, pattern_.get());
  const NodalSystem system(*this, f);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    switch (at.laws[k].kind) {
      case ContactCase::kTakingOff:
        ++report.taking_off;
        continue;
      case ContactCase::kSticking:
        ++report.sticking;
        break;
      case ContactCase::kSlipping:
        ++report.slipping;
        break;
    }
    if (c.obstacle < 0) continue;
    const Index body = obstacles_[c.obstacle].body;
    const auto share = problem_.scene.face_search[body].share(c.surface_point);
    const Vec3 force = relative(c, at.g.data());
    for (int a = 0; a < 3; ++a) {
      Eigen::Map<Vec3>(body_forces + 3 * share.corners[a]) -= share.weights[a] * force;
    }
  }
}

void NodalStage::backward(const Backward& step,
                          const Array& x,
                          solver::Factor factor,
                          const Array& g,
                          const Array& force_bar) const {
  Cotangents& bars = step.cotangents;
  const solver::Objective f = objective(problem_, pattern_.get());
  const NodalSystem system(*this, f);
  solver::LinearSystem linear(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  NodalSystem::Point at;
  at.x = x;
  system.look(at);
  const linalg::BlockMatrix H = linear.assemble(x.data(), Curvature::kExact, at.g);
  if (!factor) factor = linear.factor(system.without_coupling(at, H));
  if (!factor) throw std::domain_error("the Hessian is not positive definite at the solution");

  // The bodies' forces: minus E g, shared.
  Array eta(f.coordinates->size(), 0.0);
  std::vector<Vec3> surface_point_bar(contacts_.size(), Vec3::Zero());
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    if (c.obstacle < 0 || at.laws[k].kind == ContactCase::kTakingOff) continue;
    const Index body = obstacles_[c.obstacle].body;
    const auto share = problem_.scene.face_search[body].share(c.surface_point);
    const Vec3 force = relative(c, at.g.data());
    Vec3 weights_bar;
    for (int a = 0; a < 3; ++a) {
      const Vec3 bar = row(force_bar.data(), share.corners[a]);
      spread(c, -share.weights[a] * bar, eta.data());
      weights_bar[a] = -bar.dot(force);
    }
    surface_point_bar[k] = share.weights_by_point.transpose() * weights_bar;
  }
  Array b = g;
  system.clear_fixed(b);
  H.add_product(eta.data(), b.data());
  system.project(at, b);
  Array lambda;
  const auto solved = system.solve(at, H, *factor, true, b, kAdjointTolerance, lambda);
  if (!solved.converged) {
    // The floor of rounding may lie above the tolerance: then what has been found must do.
    Array again;
    if (!system.solve(at, H, *factor, true, b, kLargestAdjointError, again).converged) {
      throw std::domain_error("the adjoint of nodal friction did not converge");
    }
  }

  Array z = lambda;
  system.couple_transposed(at, z);
  for (std::size_t a = 0; a < z.size(); ++a) z[a] -= eta[a];
  Array z_points(x.size(), 0.0);
  f.coordinates->add_rows(z, z_points);
  Array q;
  f.hessian_product(x.data(), z_points.data(), q);
  for (double& value : q) value = -value;
  f.coordinates->add_rows(g, q);
  for (Index i = 0; i < f.coordinates->point_count(); ++i) {
    if (f.coordinates->prescribed()[i] == 0) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) bars.ends[a] += q[a];
  }
  f.for_each([&](Potential& p) { p.accumulate(x.data(), z_points.data()); });

  const projective::Swept cloths = swept(problem_);
  const Index surfaces = problem_.scene.surface_count();
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    const Coulomb& law = at.laws[k];
    if (law.kind == ContactCase::kTakingOff) continue;
    const double h_s = problem_.h * scale(c);
    const Vec3 lambda_e = relative(c, lambda.data());
    const Vec3 q_held = NodalSystem::held(c, law, relative(c, q.data()));
    const Vec3 q_e = q_held + system.turning(c, law, lambda_e);
    spread(c, q_e, bars.start.data());
    Vec3 normal_bar = Vec3::Zero();
    if (law.kind == ContactCase::kSlipping) {
      const Vec3 force = relative(c, at.g.data());
      const double normal_force = c.normal.dot(force);
      const double along = law.direction.dot(lambda_e);
      normal_bar = normal_force * lambda_e + c.friction * along * force -
                   c.normal.dot(q_held) * h_s * at.u[k];
      const Index a = problem_.scene.vertex_cloth[c.vertex];
      const Index other = c.partner >= 0
                              ? problem_.scene.vertex_cloth[c.partner]
                              : problem_.scene.cloth_count() + obstacles_[c.obstacle].body;
      const double friction_bar = normal_force * along;
      bars.contact.friction[a * surfaces + other] += 0.5 * friction_bar;
      bars.contact.friction[other * surfaces + a] += 0.5 * friction_bar;
    }
    const projective::FrameBar frame =
        projective::pull_back(c, cloths, obstacles_, normal_bar, h_s * q_e, surface_point_bar[k]);
    const auto add_vertex = [&](Index i, const Vec3& bar) {
      Eigen::Map<Vec3>(bars.start.data() + 3 * i) += (1.0 - c.fraction) * bar;
      Eigen::Map<Vec3>(problem_.inertia.target_bar.data() + 3 * i) += c.fraction * bar;
    };
    add_vertex(c.vertex, frame.vertex);
    if (c.partner >= 0) {
      add_vertex(c.partner, frame.partner);
    } else {
      const Index pose = problem_.scene.given.bodies.pose[obstacles_[c.obstacle].body];
      Eigen::Map<bodies::Pose>(bars.body_poses.data() + 7 * pose) += frame.start;
      Eigen::Map<bodies::Pose>(bars.body_targets.data() + 7 * pose) += frame.end;
    }
  }
}

}  // namespace diffcloth::step
