#pragma once

#include "contact/distance/closest.h"

namespace diffcloth::contact {

/// Edge-edge mollifier: the energy of nearly parallel edges fades, so that it stays smooth.
///
///   q = |u x v|^2,   m = (q/eps) (2 - q/eps)  for q < eps,  else 1
///
/// with edges u = a1 - a0, v = b1 - b0 and eps = 1e-3 |U|^2 |V|^2 of the rest edges.
///
/// [Li et al. 2020]
double mollifier_threshold(double rest_length_sq_a, double rest_length_sq_b);

bool mollified(const Corners& x, double eps);

double mollifier(const Corners& x, double eps);

struct Mollifier {
  double m;
  Vec12 gradient;
  Mat12 hessian;
  double m_eps;         ///< dm/d(eps)
  Vec12 gradient_eps;   ///< d(gradient)/d(eps)
};
Mollifier mollifier_derivatives(const Corners& x, double eps);

}  // namespace diffcloth::contact
