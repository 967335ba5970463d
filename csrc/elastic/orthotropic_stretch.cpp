#include "elastic/orthotropic_stretch.h"

#include <algorithm>
#include <cmath>

#include "elastic/stretch.h"

namespace diffcloth::elastic::orthotropic {
namespace {

/// A yarn of a triangle: y / |y|, or zero for y = 0, and |y|.
struct Yarn {
  Vec3 direction;
  double length;

  explicit Yarn(const Vec3& y) : direction(y / std::max(y.norm(), kShortest)), length(y.norm()) {}

  /// 1 - 1 / |y|, finite.
  double tension() const { return 1.0 - 1.0 / std::max(length, kDegenerate); }
};

/// Stiffnesses of the springs along the yarns, in addition to the isotropic energy.
Vec2 of_yarns(const Weave& weave) { return {weave.warp - weave.shear, weave.weft - weave.shear}; }

}  // namespace

double energy(const Weave& weave, const Mat32& F_rest) {
  const Mat32 F = F_rest * weave.axes();
  const double warp = F.col(0).norm();
  const double weft = F.col(1).norm();
  const double product = F.col(0).dot(F.col(1));
  const double d = F.col(0).cross(F.col(1)).norm();
  const double t = std::sqrt(warp * warp + weft * weft + 2.0 * d);
  const double below = (warp * weft + d) * (warp + weft + t);
  const double turned = 2.0 * product * product / std::max(below, kShortest);
  return 0.5 * weave.warp * (warp - 1.0) * (warp - 1.0) +
         0.5 * weave.weft * (weft - 1.0) * (weft - 1.0) + weave.shear * turned;
}

Mat32 stress(const Weave& weave, const Mat32& F_rest) {
  const Mat2 Q = weave.axes();
  const Mat32 F = F_rest * Q;
  const Vec2 k = of_yarns(weave);
  Mat32 P;
  for (int i = 0; i < 2; ++i) {
    const Yarn yarn(F.col(i));
    P.col(i) = k(i) * (yarn.length - 1.0) * yarn.direction;
  }
  return stretch::stress(weave.shear, F_rest) + P * Q.transpose();
}

Mat2 second_stress(const Weave& weave, const Mat32& F_rest) {
  const Mat2 Q = weave.axes();
  const Mat32 F = F_rest * Q;
  const Vec2 tension(Yarn(F.col(0)).tension(), Yarn(F.col(1)).tension());
  const Vec2 of_springs = of_yarns(weave).cwiseProduct(tension);
  return stretch::second_stress(weave.shear, F_rest) + Q * of_springs.asDiagonal() * Q.transpose();
}

Mat32 stress_change(const Weave& weave, const Mat32& F_rest, const Mat32& G_rest) {
  const Mat2 Q = weave.axes();
  const Mat32 F = F_rest * Q;
  const Mat32 G = G_rest * Q;
  const Vec2 k = of_yarns(weave);
  Mat32 change;
  for (int i = 0; i < 2; ++i) {
    const Yarn yarn(F.col(i));
    const Vec3 along = yarn.direction.dot(G.col(i)) * yarn.direction;
    change.col(i) = k(i) * (yarn.tension() * (G.col(i) - along) + along);
  }
  return stretch::stress_change(weave.shear, F_rest, G_rest) + change * Q.transpose();
}

}  // namespace diffcloth::elastic::orthotropic
