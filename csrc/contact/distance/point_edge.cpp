#include "contact/distance/point_edge.h"

namespace diffcloth::contact {

void consider_point_edge(const Corners& x, int p, int i, int j, double sign, Closest& best) {
  const Vec3 e = x[j] - x[i];
  const Vec3 r = x[p] - x[i];
  const double along = r.dot(e);
  const double length_sq = e.squaredNorm();
  const bool before = !(along > 0.0);  // also a degenerate edge
  const bool beyond = !before && along >= length_sq;
  const double a = before ? 0.0 : beyond ? 1.0 : along / length_sq;
  const Vec3 t = before ? r : beyond ? Vec3(x[p] - x[j]) : Vec3(r - a * e);
  const double d_sq = t.squaredNorm();
  if (!(d_sq < best.d_sq)) return;

  best.d_sq = d_sq;
  best.t = sign * t;
  best.c.setZero();
  best.c[p] = sign;
  best.c[i] = beyond ? 0.0 : -sign * (1.0 - a);
  best.c[j] = before ? 0.0 : -sign * a;
  best.c_beta.setZero();
  best.s.setZero();
  best.M_inv.setZero();
  best.parameter_count = before || beyond ? 0 : 1;
  if (best.parameter_count == 0) return;
  best.c_beta(i, 0) = sign;
  best.c_beta(j, 0) = -sign;
  best.s.col(0) = -sign * e;
  best.M_inv(0, 0) = 1.0 / length_sq;
}

}  // namespace diffcloth::contact
