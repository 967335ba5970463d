#include "contact/distance/separation.h"

#include <algorithm>

#include <Eigen/Geometry>

namespace diffcloth::contact {
namespace {

/// Squared sine of an angle below which a triangle is a sliver: its interior then is only one of several
/// candidates, because the region of the closest point is uncertain.
constexpr double kSliver = 1e-6;

double clamp01(double a) { return std::min(std::max(a, 0.0), 1.0); }

/// The parameter in [0, 1] nearest to numerator / denominator; 0 on an edge of no length.
double clamped_ratio(double numerator, double denominator) {
  return denominator > 0 ? clamp01(numerator / denominator) : 0.0;
}

/// Shortest of the vectors offered.
struct Shortest {
  Vec3 t;
  double d_sq;

  void offer(const Vec3& candidate) {
    const double candidate_sq = candidate.squaredNorm();
    if (candidate_sq < d_sq) {
      t = candidate;
      d_sq = candidate_sq;
    }
  }
};

/// From the segment that starts at the origin with direction e to the point w.
Vec3 from_segment(const Vec3& w, const Vec3& e) {
  return w - clamped_ratio(w.dot(e), e.squaredNorm()) * e;
}

Vec3 point_triangle(const Vec3& p, const Vec3& t0, const Vec3& t1, const Vec3& t2) {
  const Vec3 e0 = t1 - t0;
  const Vec3 e1 = t2 - t0;
  const Vec3 w = p - t0;
  const Vec3 n = e0.cross(e1);
  const double n_sq = n.squaredNorm();

  Shortest best{.t = w, .d_sq = w.squaredNorm()};
  if (n_sq > 0) {
    double b0 = w.cross(e1).dot(n) / n_sq;
    double b1 = e0.cross(w).dot(n) / n_sq;
    const bool sliver = n_sq < kSliver * e0.squaredNorm() * e1.squaredNorm();
    if (sliver) {
      // b0 and b1 have an error of rounding / sin(angle): correct them by one step of iterative
      // refinement.
      const Vec3 rest = w - b0 * e0 - b1 * e1;
      b0 += rest.cross(e1).dot(n) / n_sq;
      b1 += e0.cross(rest).dot(n) / n_sq;
    }
    if (b0 >= 0 && b1 >= 0 && b0 + b1 <= 1) {
      best.offer(w - b0 * e0 - b1 * e1);
      if (!sliver) return best.t;
    }
  }
  best.offer(from_segment(w, e0));
  best.offer(from_segment(w, e1));
  best.offer(from_segment(p - t1, t2 - t1));
  return best.t;
}

Vec3 edge_edge(const Vec3& a0, const Vec3& a1, const Vec3& b0, const Vec3& b1) {
  const Vec3 u = a1 - a0;
  const Vec3 v = b1 - b0;
  const Vec3 w = a0 - b0;
  const Vec3 n = u.cross(v);
  const double n_sq = n.squaredNorm();
  const double uu = u.squaredNorm();
  const double vv = v.squaredNorm();
  const double uv = u.dot(v);
  const double uw = u.dot(w);
  const double vw = v.dot(w);
  const auto at = [&](double s, double t) -> Vec3 { return w + s * u - t * v; };

  // Between the lines. An error of s, rounding / sin(angle), moves the point of a along u. With t
  // projected again, the distance changes only by that error times sin(angle), however parallel u and v
  // are.
  if (n_sq > 0) {
    const double s = v.cross(w).dot(n) / n_sq;
    const double t = (vw + s * uv) / vv;
    if (s >= 0 && s <= 1 && t >= 0 && t <= 1) return at(s, t);
  }
  Shortest best{.t = w, .d_sq = w.squaredNorm()};
  best.offer(at(0, clamped_ratio(vw, vv)));
  best.offer(at(1, clamped_ratio(vw + uv, vv)));
  best.offer(at(clamped_ratio(-uw, uu), 0));
  best.offer(at(clamped_ratio(uv - uw, uu), 1));
  return best.t;
}

}  // namespace

Vec3 separation(PairKind kind, const Corners& x) {
  switch (kind) {
    case PairKind::kPointTriangle:
      return point_triangle(x[0], x[1], x[2], x[3]);
    case PairKind::kEdgeEdge:
      return edge_edge(x[0], x[1], x[2], x[3]);
  }
  __builtin_unreachable();
}

double distance_sq(PairKind kind, const Corners& x) { return separation(kind, x).squaredNorm(); }

}  // namespace diffcloth::contact
