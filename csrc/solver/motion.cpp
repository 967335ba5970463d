#include "solver/motion.h"

#include <algorithm>
#include <cmath>
#include <ranges>

#include "solver/line_search.h"
#include "solver/stopping.h"

namespace diffcloth::solver {

using stopping::kPrescribedMotion;

namespace {

/// Change of the prescribed points to their ends, and of the points that follow them; zero elsewhere.
std::vector<double> prescribed_change(const Walk& walk, const std::vector<double>& ends) {
  const Coordinates& coordinates = *walk.f.coordinates;
  std::vector<double> d(ends.size(), 0.0);
  for (Index i = 0; i < coordinates.point_count(); ++i) {
    if (coordinates.prescribed()[i] == 0) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) d[a] = ends[a] - walk.x()[a];
  }
  coordinates.follow(walk.x(), d);
  return d;
}

/// g += H d over the rows.
void add_coupling(const Objective& f,
                  const linalg::BlockMatrix& matrix,
                  const std::vector<double>& x,
                  const std::vector<double>& d,
                  std::vector<double>& g) {
  // The matrix holds the couplings with pins and prescribed coordinates that are in the base pattern.
  std::vector<double> d_z;
  f.coordinates->take_rows(d, d_z);
  std::vector<double> product(d_z.size(), 0.0);
  matrix.add_product(d_z.data(), product.data());
  f.coordinates->add_rows(product, g);
  const double* const motion = d.data();
  double* const sum = g.data();
  f.for_each([&](const Potential& p) {
    p.add_left_out_products(x.data(), Curvature::kPositive, {.z = {&motion, 1}, .y = {&sum, 1}});
  });
}

/// Move along the change p by its collision-free fraction, towards the ends. Returns that fraction.
double follow(Walk& walk, const std::vector<double>& ends, const std::vector<double>& p) {
  std::vector<double> to;
  const double alpha = walk.watch(p, std::min(1.0, walk.f.largest_fraction(walk.x(), p)), to);
  if (!(alpha > 0.0)) return 0.0;
  if (alpha == 1.0) {
    // Exact to the bit: the vertices of links follow nodes, and differ from these ends by rounding.
    for (Index i = 0; i < walk.f.coordinates->point_count(); ++i) {
      if (walk.f.coordinates->prescribed()[i] == 0) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) to[a] = ends[a];
    }
  }
  walk.f.update_duals(walk.x().data(), p.data(), alpha, to.data());
  walk.go(to);
  walk.refresh();
  return alpha;
}

/// Descend with the projected Hessian P, then move towards the ends. Returns the covered fraction of the
/// remaining motion d.
///
///   P p = -g        along a line search, prescribed points at rest
///   P q = -P_xo d   jointly with d
///
/// Their sum is the joint Newton step. Separately, q and d vanish together, so that the end is a
/// continuous function of d, also at d = 0.
///
/// @param descends  false: p is left out
double descend_and_follow(Walk& walk, const std::vector<double>& ends, bool descends) {
  const std::vector<double> d = prescribed_change(walk, ends);
  const linalg::BlockMatrix matrix =
      walk.system.assemble(walk.x().data(), Curvature::kPositive, walk.g());
  // M/h^2 plus positive semi-definite parts: positive definite up to rounding.
  const Factor factor = walk.system.factor(matrix);
  if (!factor) return follow(walk, ends, d);
  ++walk.context.counts->projected;
  std::vector<double> b(d.size(), 0.0);
  add_coupling(walk.f, matrix, walk.x(), d, b);
  std::vector<double> q;
  walk.system.solve(*factor, b, q);
  for (std::size_t a = 0; a < q.size(); ++a) q[a] += d[a];
  if (descends) {
    std::vector<double> p;
    walk.system.solve(*factor, walk.g(), p);
    // Single precision may turn the direction of an ill-conditioned Hessian uphill.
    if (dot(walk.g(), p) < 0.0) search(walk, p, farthest(walk, p, 1.0));
  }
  return follow(walk, ends, q);
}

/// An iterate during the motion, and the fraction of the whole motion there, less than one.
struct Stop {
  Walk::Place place;
  double fraction;
};

bool has_arrived(const Walk& walk, const PrescribedMotion& motion) {
  std::vector<double> ends(walk.x());
  motion.at(1.0, ends.data());
  for (Index i = 0; i < walk.f.coordinates->point_count(); ++i) {
    if (walk.f.coordinates->prescribed()[i] == 0) continue;
    if (row(walk.x().data(), i) != row(ends.data(), i)) return false;
  }
  return true;
}

/// Restore the last iterate from which the prescribed points can be placed on their motion.
///
/// @return the fraction there; 1 if the motion has no length, as nothing can be missing
double halt(Walk& walk, const PrescribedMotion& motion, const std::vector<Stop>& way) {
  for (const Stop& stop : std::views::reverse(way)) {
    walk.back(stop.place);
    std::vector<double> to = walk.x();
    motion.at(stop.fraction, to.data());
    if (walk.watch(to) < 1.0) continue;
    walk.go(to);
    walk.refresh();
    return has_arrived(walk, motion) ? 1.0 : stop.fraction;
  }
  return has_arrived(walk, motion) ? 1.0 : way.front().fraction;
}

/// Move through all portions; the iterates of the last portion are written to `way`.
double go_to_the_end(Walk& walk,
                     const PrescribedMotion& motion,
                     bool descends,
                     std::vector<Stop>& way) {
  const int portions = motion.portions();
  std::vector<double> ends(walk.x());
  for (int k = 0; k < portions; ++k) {
    motion.at((k + 1.0) / portions, ends.data());
    double remaining = 1.0;
    double checked = 1.0;
    way.clear();
    for (int iteration = 1; remaining > 0.0; ++iteration) {
      // The remaining part may drown in rounding, if surfaces approach one another without end.
      const double fraction = std::min((k + 1.0 - remaining) / portions, std::nextafter(1.0, 0.0));
      way.push_back({.place = walk.place(), .fraction = fraction});
      if (!walk.spend()) return halt(walk, motion, way);
      // If a motion is blocked, a descent reopens the gaps.
      const double alpha = descend_and_follow(walk, ends, descends || iteration > 1);
      remaining *= 1.0 - alpha;
      if (iteration % kPrescribedMotion.stuck_iterations == 0) {
        if (checked - remaining < kPrescribedMotion.stuck_progress) return halt(walk, motion, way);
        checked = remaining;
      }
    }
  }
  return 1.0;
}

}  // namespace

double arrive(Walk& walk, const PrescribedMotion& motion, bool descends) {
  // Without a descent and a motion, a solution must stay unchanged to the bit.
  if (!descends && has_arrived(walk, motion)) return 1.0;
  std::vector<Stop> way;
  try {
    return go_to_the_end(walk, motion, descends, way);
  } catch (const TimeIsUp&) {  // in a portion, whose start is in `way`
    walk.context.checkpoint->stop_clock();
    return halt(walk, motion, way);
  }
}

}  // namespace diffcloth::solver
