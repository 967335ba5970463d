// Dry frictional contact at nodes. Its adjoint is in nodal/adjoint.cpp.
//
// Let g(x) be the gradient of inertia + elasticity + anchors. Contact c acts through a map E with
// orthonormal rows: on a body's obstacle E x = x_i; between vertices E x = (x_i - x_j) / sqrt(2) = s
// (x_i - x_j), s = 1 for obstacles. With the frame of c fixed by x_n, xhat and the poses,
//
//   impulse            r = h s E g(x)          (no other force acts along E: the step's momentum)
//   relative velocity  u = E (x - x_n) / (h s) - v_out,
//
// and (r, u) obey the law of Signorini and Coulomb: r = Phi(r - rho u), see projective/coulomb.h. The
// choice of masses rho > 0 has no influence on the solution; h^2 times the diagonal of the constant
// matrix M / h^2 + L predicts its cases well. The impulses are therefore no unknowns. At all other
// nodes, g = 0. Let P = I - n n^T. The equations along E of each case are
//
//   taking off   E g = 0
//   sticking     u = 0
//   slipping     n . u = 0,   P E g - mu (n . E g) t = 0,   t = -u_T / |u_T|.
//
// Let Z project onto the subspace that no constraint holds (E^T P E of slipping nodes, zero for sticking
// nodes), L = Z - sum mu E^T t n^T E, and  F = sum k E^T (P - t t^T) E  with k = mu r_n / (h^2 s^2
// |u_T|), as friction turns with the slip. With the Hessian H of the energy, a change w = Z w of the
// free part changes the equations by
//
//   K w = L H w + F w.
//
// K is not symmetric, but S = Z H Z + F + (I - Z) rho / h^2 is: the system without the coupling of
// friction and normal force. S has the pattern of H; its Cholesky factor preconditions GMRES, and proves
// that the solution is a minimum for frozen friction. Away from the solution the same operators, with t
// and k of s = r - rho u, define a semismooth Newton method.

#include "step/nodal/system.h"

#include <algorithm>
#include <array>
#include <functional>
#include <numbers>
#include <utility>

#include <Eigen/Core>

#include "projective/coupled_coulomb.h"
#include "solver/stopping.h"

namespace diffcloth::step {

using solver::stopping::kNodal;

using Array = std::vector<double>;
using projective::ContactCase;
using projective::Coulomb;
using projective::NodalContact;

namespace {

/// Columns of the matrix of the linearized law that are solved for at a time.
constexpr Eigen::Index kColumns = 48;

Vec3 tangential(const Vec3& e, const Vec3& n) { return e - n * n.dot(e); }

}  // namespace

double scale(const NodalContact& c) { return c.partner < 0 ? 1.0 : 1.0 / std::numbers::sqrt2; }

Vec3 relative(const NodalContact& c, const double* v) {
  if (c.partner < 0) return row(v, c.vertex);
  return scale(c) * (row(v, c.vertex) - row(v, c.partner));
}

void spread(const NodalContact& c, const Vec3& e, double* v) {
  const Vec3 part = scale(c) * e;
  Eigen::Map<Vec3>(v + 3 * c.vertex) += part;
  if (c.partner >= 0) Eigen::Map<Vec3>(v + 3 * c.partner) -= part;
}

double reduced(const Array& masses, const NodalContact& c) {
  const double m = masses[c.vertex];
  if (c.partner < 0) return m;
  return m * masses[c.partner] / (m + masses[c.partner]);
}

void NodalSystem::look(Point& at) const {
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

Vec3 NodalSystem::velocity(const NodalContact& c, const Array& x) const {
  const Vec3 moved = relative(c, x.data()) - relative(c, p_.start.data());
  return moved / (p_.h * scale(c)) - c.velocity;
}

Vec3 NodalSystem::held(const NodalContact& c, const Coulomb& law, const Vec3& e) {
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

Vec3 NodalSystem::turning(const NodalContact& c, const Coulomb& law, const Vec3& e) const {
  if (law.kind != ContactCase::kSlipping) return Vec3::Zero();
  const double k = law.ratio * rho(c) * inv_h_sq_ / (scale(c) * scale(c));
  const Vec3 across = tangential(e, c.normal) - law.direction * law.direction.dot(e);
  return k * across;
}

void NodalSystem::project(const Point& at, Array& v) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    spread(c, -held(c, at.laws[k], relative(c, v.data())), v.data());
  }
  clear_fixed(v);
}

void NodalSystem::clear_fixed(Array& v) const {
  for (Index i = 0; i < f_.coordinates->row_count(); ++i) {
    if (!f_.coordinates->is_free(i)) std::fill_n(v.begin() + 3 * std::ptrdiff_t{i}, 3, 0.0);
  }
}

void NodalSystem::couple(const Point& at, Array& v) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    const Vec3 e = relative(c, v.data());
    spread(c, -held(c, at.laws[k], e) - c.friction * c.normal.dot(e) * at.laws[k].direction,
           v.data());
  }
  clear_fixed(v);
}

Array NodalSystem::hessian_product(const Point& at, const Array& v) const {
  Array points(at.x.size(), 0.0);
  f_.coordinates->add_rows(v, points);
  Array product;
  f_.hessian_product(at.x.data(), points.data(), product);
  Array rows;
  f_.coordinates->take_rows(product, rows);
  return rows;
}

void NodalSystem::couple_transposed(const Point& at, Array& v) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    const Vec3 e = relative(c, v.data());
    spread(c, -c.friction * at.laws[k].direction.dot(e) * c.normal, v.data());
  }
  clear_fixed(v);
}

void NodalSystem::add_turning(const Point& at, const Array& v, Array& y) const {
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    spread(c, turning(c, at.laws[k], relative(c, v.data())), y.data());
  }
}

linalg::GmresOutcome NodalSystem::solve(const Point& at,
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
  return linalg::gmres(apply, precondition, b, tolerance, kNodal.most_products, w);
}

Array NodalSystem::constraint_step(const Point& at) const {
  Array d(f_.coordinates->size(), 0.0);
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    spread(c, -p_.h * scale(c) * held(c, at.laws[k], at.u[k]), d.data());
  }
  return d;
}

Array NodalSystem::right_side(const Point& at,
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

bool NodalSystem::clear_approach(Array& x) const {
  bool any = false;
  for (const NodalContact& c : contacts_) {
    const double approach = c.normal.dot(velocity(c, x));
    if (!(approach < 0.0)) continue;
    spread(c, -p_.h * scale(c) * approach * c.normal, x.data());
    any = true;
  }
  return any;
}

NodalSystem::Linearized NodalSystem::solve_linearized(const Point& at,
                                                      const linalg::CholeskyFactor& H) const {
  const auto m = static_cast<Eigen::Index>(contacts_.size());
  const std::size_t size = f_.coordinates->size();
  const auto contact = [&](Eigen::Index k) -> const NodalContact& {
    return contacts_[static_cast<std::size_t>(k)];
  };
  const auto to_rows = [&](const NodalContact& c, const Vec3& r, Array& force) {
    spread(c, r / (p_.h * scale(c)), force.data());
  };
  const auto to_velocity = [&](const NodalContact& c, const Array& p) -> Vec3 {
    return relative(c, p.data()) / (p_.h * scale(c));
  };
  // The change of each velocity by each impulse, some columns at a time.
  Eigen::MatrixXd W(3 * m, 3 * m);
  std::vector<Array> columns(static_cast<std::size_t>(std::min(kColumns, 3 * m)), Array(size));
  for (Eigen::Index first = 0; first < 3 * m; first += kColumns) {
    const Eigen::Index count = std::min(kColumns, 3 * m - first);
    std::vector<const double*> forces;
    std::vector<double*> changes;
    for (Eigen::Index j = 0; j < count; ++j) {
      Array& column = columns[static_cast<std::size_t>(j)];
      std::ranges::fill(column, 0.0);
      to_rows(contact((first + j) / 3), Vec3::Unit((first + j) % 3), column);
      forces.push_back(column.data());
      changes.push_back(column.data());
    }
    H.solve(forces, changes);
    for (Eigen::Index j = 0; j < count; ++j) {
      for (Eigen::Index k = 0; k < m; ++k) {
        W.block<3, 1>(3 * k, first + j) =
            to_velocity(contact(k), columns[static_cast<std::size_t>(j)]);
      }
    }
  }

  Array force(size, 0.0);
  std::transform(at.g.begin(), at.g.begin() + static_cast<std::ptrdiff_t>(p_.cloth_size),
                 force.begin(), std::negate<>());
  clear_fixed(force);
  Linearized result{.p = Array(size, 0.0), .impulses = {}};
  H.solve(force.data(), result.p.data());
  Eigen::VectorXd q(3 * m);
  Eigen::VectorXd r(3 * m);
  std::vector<projective::RoughPlane> planes;
  for (Eigen::Index k = 0; k < m; ++k) {
    const NodalContact& c = contact(k);
    q.segment<3>(3 * k) = at.u[static_cast<std::size_t>(k)] + to_velocity(c, result.p);
    r.segment<3>(3 * k) = at.laws[static_cast<std::size_t>(k)].impulse;
    planes.push_back({.normal = c.normal, .friction = c.friction});
  }
  projective::solve_coulomb(W, q, planes, kNodal.law_tolerance, kNodal.most_sweeps, r);
  for (Eigen::Index k = 0; k < m; ++k) {
    result.impulses.emplace_back(r.segment<3>(3 * k));
    to_rows(contact(k), r.segment<3>(3 * k), force);
  }
  H.solve(force.data(), result.p.data());
  return result;
}

double NodalSystem::frozen_energy_change(const Point& at,
                                         const std::vector<Vec3>& impulses,
                                         const Array& to) const {
  double change = f_.energy_change(at.x.data(), to.data());
  for (std::size_t k = 0; k < contacts_.size(); ++k) {
    const NodalContact& c = contacts_[k];
    const double limit = c.friction * impulses[k].dot(c.normal);
    change += limit *
              (tangential(velocity(c, to), c.normal).norm() - tangential(at.u[k], c.normal).norm());
  }
  return change;
}

namespace {

/// Z by blocks: Z_pp and, in pairs, Z_p'p of each vertex p; the identity at vertices without contact.
class Projections {
 public:
  Projections(const std::vector<NodalContact>& contacts,
              const std::vector<Index>& partner,
              const std::vector<Coulomb>& laws)
      : partner_(partner), place_(partner.size(), -1) {
    for (std::size_t k = 0; k < contacts.size(); ++k) {
      const NodalContact& c = contacts[k];
      if (laws[k].kind == ContactCase::kTakingOff) continue;
      Mat3 I_minus_P = Mat3::Identity();
      if (laws[k].kind == ContactCase::kSlipping) I_minus_P = c.normal * c.normal.transpose();
      const double s = scale(c);
      const Mat3 own = Mat3::Identity() - s * s * I_minus_P;
      const Mat3 other = s * s * I_minus_P;
      place_[c.vertex] = static_cast<Index>(blocks_.size());
      blocks_.push_back({.own = own, .other = other});
      if (c.partner >= 0) {
        place_[c.partner] = static_cast<Index>(blocks_.size());
        blocks_.push_back({.own = own, .other = other});
      }
    }
  }

  bool holds(Index p) const { return place_[p] >= 0; }
  const Mat3& own(Index p) const { return blocks_[place_[p]].own; }

  /// Rows to which Z maps a vertex: itself, and its partner; -1 if there is none.
  std::array<std::pair<Index, Mat3>, 2> images(Index p) const {
    std::array<std::pair<Index, Mat3>, 2> rows{std::pair{p, Mat3(Mat3::Identity())},
                                               std::pair{Index{-1}, Mat3(Mat3::Zero())}};
    if (!holds(p)) return rows;
    rows[0].second = own(p);
    if (partner_[p] >= 0) rows[1] = {partner_[p], blocks_[place_[p]].other};
    return rows;
  }

 private:
  struct Block {
    Mat3 own;
    Mat3 other;
  };
  const std::vector<Index>& partner_;
  std::vector<Index> place_;  // index of each vertex's block
  std::vector<Block> blocks_;
};

/// A block of H that was removed from the matrix, to be projected.
struct Moved {
  Index p, q;
  Mat3 block;
};

/// Project the blocks of vertices against obstacles in place; return the blocks of pairs.
std::vector<Moved> project_in_place(const Projections& Z,
                                    const std::vector<Index>& partner,
                                    linalg::BlockMatrix& S) {
  const auto n = static_cast<Index>(partner.size());
  const linalg::BlockPattern& pattern = S.pattern();
  std::vector<Moved> moved;
  for (Index q = 0; q < n; ++q) {
    for (Index k = pattern.column_start()[q]; k < pattern.column_start()[q + 1]; ++k) {
      const Index p = pattern.row()[k];
      if (p >= n || (!Z.holds(p) && !Z.holds(q))) continue;
      Eigen::Map<Mat3> block(S.blocks() + 9 * static_cast<std::ptrdiff_t>(k));
      if (partner[p] < 0 && partner[q] < 0) {
        if (Z.holds(p)) block = Z.own(p) * block;
        if (Z.holds(q)) block = block * Z.own(q).transpose();
        continue;
      }
      moved.push_back({.p = p, .q = q, .block = block});
      block.setZero();
    }
  }
  return moved;
}

/// Add a removed block, projected, at all images of its two vertices.
void add_projected(const Projections& Z,
                   const std::vector<char>& fixed,
                   const Moved& m,
                   linalg::BlockMatrix& S) {
  for (const auto& [a, Z_a] : Z.images(m.p)) {
    for (const auto& [b, Z_b] : Z.images(m.q)) {
      if (a < 0 || b < 0) continue;
      // Rows of fixed points are not part of the matrix, and their pattern is the base pattern.
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

}  // namespace

linalg::BlockMatrix NodalSystem::without_coupling(const Point& at,
                                                  const linalg::BlockMatrix& H) const {
  linalg::BlockMatrix S = H;
  const Projections Z(contacts_, partner_, at.laws);
  for (const Moved& moved : project_in_place(Z, partner_, S)) {
    add_projected(Z, p_.scene.prescribed, moved, S);
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

}  // namespace diffcloth::step
