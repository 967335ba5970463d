#pragma once

#include "common/types.h"
#include "contact/pair.h"

namespace diffcloth::contact {

/// Threshold of |u x v|^2 below which an edge-edge pair is mollified: 1e-3 |U|^2 |V|^2 of the rest edges
/// [m^4].
///
/// Against the segment of a round body the threshold is 0.1 |U|^2 |V|^2. The segment is at distance r
/// from the touching surface: the closest point on a chord of length l moves from one end to the other
/// as the ends move by (l sin)^2 / (2 r) against each other, and the force moves with it.
double mollifier_threshold(double rest_length_sq_a, double rest_length_sq_b, bool is_round = false);

/// Factor that makes the force of two edges continuous where they become parallel:
///
///   q = |u x v|^2,   m = (q / eps) (2 - q / eps) for q < eps, else 1.
double mollifier(const Corners& x, double eps);

/// True if m(q) is below its plateau, i.e. q < eps.
bool mollified(const Corners& x, double eps);

/// m with its derivatives by the corners, and by eps at fixed corners.
struct Mollifier {
  double m;
  Vec12 gradient;
  Mat12 hessian;
  double m_eps;
  Vec12 gradient_eps;  ///< d gradient / d eps
};

/// Value and derivatives; on the plateau m = 1 and all derivatives vanish.
Mollifier mollifier_derivatives(const Corners& x, double eps);

}  // namespace diffcloth::contact
