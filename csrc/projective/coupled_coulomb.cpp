#include "projective/coupled_coulomb.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "projective/coulomb.h"
#include "solver/stopping.h"

namespace diffcloth::projective {

using solver::stopping::kCoupledCoulomb;

namespace {

/// Velocity of a slipping contact as a function of the direction of friction: t = cos(a) t_1 + sin(a)
/// t_2, and r = r_n (n + mu t) with r_n such that n . u = 0.
class Slip {
 public:
  Slip(const Mat3& A, const Vec3& b, const RoughPlane& plane, const Vec3& last)
      : A_(A), b_(b), plane_(plane) {
    const Vec3& n = plane.normal;
    Vec3 t = last - n * n.dot(last);
    if (!(t.norm() > 0.0)) t = -(b - n * n.dot(b));
    if (!(t.norm() > 0.0)) t = n.unitOrthogonal();
    t_1_ = t.normalized();
    t_2_ = n.cross(t_1_);
  }

  struct At {
    Vec3 r;
    double across;  ///< component of u across t; infinite if no impulse keeps n . u at zero
    double along;   ///< component of u along t: negative if friction brakes
  };

  At at(double angle) const {
    const Vec3 t = std::cos(angle) * t_1_ + std::sin(angle) * t_2_;
    const Vec3 direction = plane_.normal + plane_.friction * t;
    const double compliance = plane_.normal.dot(A_ * direction);
    if (!(compliance > 0.0)) return {.r = Vec3::Zero(), .across = INFINITY, .along = INFINITY};
    const Vec3 r = -plane_.normal.dot(b_) / compliance * direction;
    const Vec3 u = b_ + A_ * r;
    return {.r = r, .across = plane_.normal.cross(t).dot(u), .along = t.dot(u)};
  }

  /// Root between two angles at which the component across t has opposite signs.
  At refine(double a, At at_a, double b, At at_b) const {
    double weight_a = 1.0;
    double weight_b = 1.0;
    int side = 0;
    At best = std::abs(at_a.across) < std::abs(at_b.across) ? at_a : at_b;
    for (int k = 0; k < kCoupledCoulomb.refinements && std::abs(b - a) > kCoupledCoulomb.angle &&
                    best.across != 0.0;
         ++k) {
      const double f_a = weight_a * at_a.across;
      const double f_b = weight_b * at_b.across;
      const double c = (a * f_b - b * f_a) / (f_b - f_a);
      if (!(c > std::min(a, b) && c < std::max(a, b))) break;
      const At at_c = at(c);
      if (!std::isfinite(at_c.across)) break;
      if (std::abs(at_c.across) < std::abs(best.across)) best = at_c;
      // Illinois method: halve the weight of the end that is retained.
      if ((at_c.across < 0.0) == (at_a.across < 0.0)) {
        a = c;
        at_a = at_c;
        weight_a = 1.0;
        if (side == 1) weight_b *= 0.5;
        side = 1;
      } else {
        b = c;
        at_b = at_c;
        weight_b = 1.0;
        if (side == 2) weight_a *= 0.5;
        side = 2;
      }
    }
    return best;
  }

  Vec3 solve() const {
    // Search from the last direction to both sides.
    constexpr double kStep = 2.0 * std::numbers::pi / kCoupledCoulomb.directions;
    At best{.r = Vec3::Zero(), .across = INFINITY, .along = INFINITY};
    At left = at(0.0);
    At right = left;
    for (int k = 1; k <= kCoupledCoulomb.directions / 2; ++k) {
      for (const double side : {1.0, -1.0}) {
        At& last = side > 0.0 ? right : left;
        const At next = at(side * kStep * k);
        if (std::isfinite(last.across) && std::isfinite(next.across) &&
            (last.across < 0.0) != (next.across < 0.0)) {
          const At found = refine(side * kStep * (k - 1), last, side * kStep * k, next);
          if (found.along <= 0.0) return found.r;
        }
        if (next.along <= 0.0 && std::abs(next.across) < std::abs(best.across)) best = next;
        last = next;
      }
    }
    return best.r;
  }

 private:
  const Mat3& A_;
  const Vec3& b_;
  const RoughPlane& plane_;
  Vec3 t_1_, t_2_;
};

/// The law at all contacts as equations  r = Phi(r - m u), u = q + W r, see coulomb.h.
class Equations {
 public:
  Equations(const Eigen::MatrixXd& W,
            const Eigen::VectorXd& q,
            const std::vector<RoughPlane>& planes)
      : W_(W), q_(q), planes_(planes) {}

  /// Newton steps, as long as they contract the residual.
  void polish(Eigen::VectorXd& r) const {
    Eigen::VectorXd left = residual(r);
    for (int k = 0; k < kCoupledCoulomb.newton_steps; ++k) {
      const Eigen::VectorXd next = r - jacobian(r).partialPivLu().solve(left);
      const Eigen::VectorXd left_next = residual(next);
      if (!(left_next.norm() < kCoupledCoulomb.newton_contraction * left.norm())) return;
      r = next;
      left = left_next;
    }
  }

 private:
  /// Mass scale of a contact: the inverse of its mean compliance [kg].
  double mass(Eigen::Index k) const { return 3.0 / W_.block<3, 3>(3 * k, 3 * k).trace(); }

  /// r - m u of a contact.
  Vec3 probe(Eigen::Index k, const Eigen::VectorXd& r, const Eigen::VectorXd& u) const {
    return r.segment<3>(3 * k) - mass(k) * u.segment<3>(3 * k);
  }

  Coulomb law(Eigen::Index k, const Vec3& s) const {
    const RoughPlane& plane = planes_[static_cast<std::size_t>(k)];
    return coulomb(s, plane.normal, plane.friction);
  }

  Eigen::Index size() const { return static_cast<Eigen::Index>(planes_.size()); }

  Eigen::VectorXd residual(const Eigen::VectorXd& r) const {
    const Eigen::VectorXd u = q_ + W_ * r;
    Eigen::VectorXd left = r;
    for (Eigen::Index k = 0; k < size(); ++k) {
      left.segment<3>(3 * k) -= law(k, probe(k, r, u)).impulse;
    }
    return left;
  }

  Eigen::MatrixXd jacobian(const Eigen::VectorXd& r) const {
    const Eigen::VectorXd u = q_ + W_ * r;
    Eigen::MatrixXd J = Eigen::MatrixXd::Identity(r.size(), r.size());
    for (Eigen::Index k = 0; k < size(); ++k) {
      const Mat3 D = impulse_by_probe(k, probe(k, r, u));
      J.middleRows<3>(3 * k) += mass(k) * D * W_.middleRows<3>(3 * k);
      J.block<3, 3>(3 * k, 3 * k) -= D;
    }
    return J;
  }

  Mat3 impulse_by_probe(Eigen::Index k, const Vec3& s) const {
    const auto& [n, friction] = planes_[static_cast<std::size_t>(k)];
    const Coulomb at = law(k, s);
    switch (at.kind) {
      case ContactCase::kTakingOff:
        return Mat3::Zero();
      case ContactCase::kSticking:
        return Mat3::Identity();
      case ContactCase::kSlipping:
        break;
    }
    const Vec3& t = at.direction;
    // dr = turn ds orthogonal to the slip; with ratio = limit / (|s_T| - limit), turn = limit / |s_T|.
    const double turn = at.ratio / (1.0 + at.ratio);
    const Mat3 across = Mat3::Identity() - n * n.transpose() - t * t.transpose();
    return (n + friction * t) * n.transpose() + turn * across;
  }

  const Eigen::MatrixXd& W_;
  const Eigen::VectorXd& q_;
  const std::vector<RoughPlane>& planes_;
};

}  // namespace

Vec3 solve_coulomb(const Mat3& A, const Vec3& b, const RoughPlane& plane, const Vec3& last) {
  const Vec3& n = plane.normal;
  if (!(n.dot(b) < 0.0)) return Vec3::Zero();
  if (!(plane.friction > 0.0)) return -n.dot(b) / n.dot(A * n) * n;
  Vec3 stuck = -A.llt().solve(b);
  const double r_n = n.dot(stuck);
  if (r_n > 0.0 && (stuck - r_n * n).norm() <= plane.friction * r_n) return stuck;
  return Slip(A, b, plane, last).solve();
}

bool solve_coulomb(const Eigen::MatrixXd& W,
                   const Eigen::VectorXd& q,
                   const std::vector<RoughPlane>& planes,
                   double tolerance,
                   int max_sweeps,
                   Eigen::VectorXd& r) {
  const auto m = static_cast<Eigen::Index>(planes.size());
  const Equations equations(W, q, planes);
  const Eigen::VectorXd guess = r;
  double share = 1.0;
  for (int sweep = 0; sweep < max_sweeps; ++sweep) {
    if (sweep > 0 && sweep % kCoupledCoulomb.sweeps_per_share == 0)
      share = std::max(kCoupledCoulomb.least_share, 0.5 * share);
    double change = 0.0;  // in this sweep; `moved`: since the start
    double moved = 0.0;
    double size = 0.0;
    for (Eigen::Index k = 0; k < m; ++k) {
      const Mat3 A = W.block<3, 3>(3 * k, 3 * k);
      const Vec3 last = r.segment<3>(3 * k);
      // W is symmetric, and its columns are contiguous.
      const Vec3 b = q.segment<3>(3 * k) + W.middleCols<3>(3 * k).transpose() * r - A * last;
      const Vec3 solution = solve_coulomb(A, b, planes[static_cast<std::size_t>(k)], last);
      const Vec3 next = last + share * (solution - last);
      change = std::max(change, (next - last).norm());
      moved = std::max(moved, (next - guess.segment<3>(3 * k)).norm());
      size = std::max(size, next.norm());
      r.segment<3>(3 * k) = next;
    }
    if (change <= std::max(tolerance * moved, kCoupledCoulomb.rounding * size)) return true;
    if (sweep % kCoupledCoulomb.sweeps_per_polish == kCoupledCoulomb.sweeps_per_polish - 1)
      equations.polish(r);
  }
  return false;
}

}  // namespace diffcloth::projective
