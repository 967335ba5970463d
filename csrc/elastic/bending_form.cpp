#include "elastic/bending_form.h"

#include <cmath>

namespace diffcloth::elastic {
namespace {

/// (aa, ab, bb) of (uu, uv, vv).
Mat3 to_material_axes(const Vec2& axis) {
  const double cc = axis.x() * axis.x();
  const double cs = axis.x() * axis.y();
  const double ss = axis.y() * axis.y();
  Mat3 T;
  T << cc, 2.0 * cs, ss, -cs, cc - ss, cs, ss, -2.0 * cs, cc;
  return T;
}

/// Transform a form on (aa, ab, bb) into a form on (uu, uv, vv).
Mat3 in_rest_frame(const Vec2& axis, double aa, double bb, double both, double ab) {
  Mat3 Q;
  Q << aa, 0.0, both, 0.0, ab, 0.0, both, 0.0, bb;
  const Mat3 T = to_material_axes(axis);
  return T.transpose() * Q * T;
}

}  // namespace

Mat3 isotropic_form(double poisson) {
  Mat3 Q;
  Q << 1.0, 0.0, poisson, 0.0, 2.0 * (1.0 - poisson), 0.0, poisson, 0.0, 1.0;
  return Q;
}

Mat3 isotropic_form_derivative() {
  Mat3 Q;
  Q << 0.0, 0.0, 1.0, 0.0, -2.0, 0.0, 1.0, 0.0, 0.0;
  return Q;
}

Mat3 plate_form(const Plate& p) {
  const double both = p.poisson * std::sqrt(p.warp * p.weft);
  return in_rest_frame(p.axis, p.warp, p.weft, both, 4.0 * p.twill - p.warp - p.weft - 2.0 * both);
}

std::array<Mat3, 4> plate_form_derivatives(const Plate& p) {
  const double root = std::sqrt(p.warp * p.weft);
  const double by_warp = 0.5 * p.poisson * (root > 0.0 ? root / p.warp : 1.0);
  const double by_weft = 0.5 * p.poisson * (root > 0.0 ? root / p.weft : 1.0);
  return {in_rest_frame(p.axis, 1.0, 0.0, by_warp, -1.0 - 2.0 * by_warp),
          in_rest_frame(p.axis, 0.0, 1.0, by_weft, -1.0 - 2.0 * by_weft),
          in_rest_frame(p.axis, 0.0, 0.0, 0.0, 4.0),
          in_rest_frame(p.axis, 0.0, 0.0, root, -2.0 * root)};
}

}  // namespace diffcloth::elastic
