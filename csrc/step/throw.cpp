#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <span>

#include "contact/pair_groups.h"
#include "solver/linear_system.h"
#include "step/problem.h"
#include "step/step.h"

// Everything rests at x_n. The contacts of two surfaces push with the forces f, everything else with F:
// weights, elasticity, springs, drives, and the contacts of other surfaces. A vertex, or a tree of links, is
// pushed by the share
//
//   (1 - a) f,   a = -w.F / w.f  within [0, 1],   w = A^-1 f,
//
// A the positive Hessian of all potentials but contact: loads may oppose the push, up to balance; any
// load in the direction of the push is no energy of the barrier. All points of the pair move by s u, u =
// A^-1 (1 - a) f, so that the distance of a contact is d + s d', with d'_i the part of d' from one
// vertex or tree. With  mu = u.(1 - a) f,  the load  l = -u.(a f)  and the barrier's energy
//
//   E(s) = sum over its contacts of (d'_i / d') kappa w m b((d + s d')^2),
//
// its first step ends at the minimum of  mu s^2 / 2 + E(s) - l s.  The energy stored there, down to the
// balance of push and load, becomes kinetic energy at most. The speed follows from implicit Euler, which
// dissipates most of the energy if a step is longer than the barrier's time scale: 99 % at 10 ms with a
// default barrier stiffness.

namespace diffcloth::step {
namespace {

using contact::Contact;
using Array = std::vector<double>;

constexpr int kHalvings = 50;  // halvings of an interval, to the resolution of float64

/// Smallest argument at which a monotone condition holds.
template <class Condition>
double first_point(double low, double high, Condition&& holds) {
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high);
    (holds(middle) ? high : low) = middle;
  }
  return high;
}

/// Owners: bodies that move as a whole, by rows of the unknowns and by vertices: first the vertices of
/// cloths, then trees.
class Owners {
 public:
  explicit Owners(const Scene& scene)
      : cloths_(scene.cloth_vertex_count()),
        of_row_(static_cast<std::size_t>(cloths_ + scene.mechanisms.node_count()), -1) {
    const bodies::MechanismsDescription& given = scene.mechanisms.given();
    for (Index i = 0; i < cloths_; ++i) of_row_[i] = i;
    for (Index c = 0; c < scene.mechanisms.coordinate_count(); ++c) {
      of_row_[cloths_ + scene.mechanisms.slot(c) / 3] = cloths_ + given.coordinate_tree[c];
    }
    for (Index v = 0; v < scene.vertex_count(); ++v) {
      const Index body = scene.collision_mesh.vertex_surface[v] - scene.cloth_count();
      const bool is_linked = body >= 0 && !given.surface_link.empty();
      of_vertex_.push_back(is_linked ? cloths_ + given.links[given.surface_link[body]].tree : v);
    }
  }

  Index row_count() const { return static_cast<Index>(of_row_.size()); }
  Index of_row(Index row) const { return of_row_[row]; }
  Index of_vertex(Index vertex) const { return of_vertex_[vertex]; }

  /// a.b over the rows of each owner.
  std::map<Index, double> products(const Array& a, const Array& b) const {
    std::map<Index, double> result;
    for (Index i = 0; i < row_count(); ++i) {
      const double product = row(a.data(), i).dot(row(b.data(), i));
      if (product != 0.0) result[of_row(i)] += product;
    }
    return result;
  }

 private:
  Index cloths_;
  std::vector<Index> of_row_;
  std::vector<Index> of_vertex_;
};

/// The contacts of one owner, with distances that change at their initial rates.
class Course {
 public:
  /// @param rate  of the distance
  /// @param own   the part of the rate from this owner
  void add(const Contact& c, double rate, double own, double d_hat) {
    const double d = std::sqrt(c.closest.d_sq);
    terms_.push_back({.stiffness = c.kappa * c.weight * c.mollifier,
                      .d = d,
                      .rate = rate,
                      .own = own,
                      .xi = c.xi,
                      .d_hat = d_hat});
    if (rate > 0.0) end_ = std::max(end_, (d_hat + c.xi - d) / rate);
  }

  /// ds/dt after the barrier has acted, in steps of h.
  double final_rate(double mu, double load, double h) const {
    // A push that did not decrease along the path would end at 1.
    const double first = first_point(0.0, 1.0, [&](double s) { return mu * s + slope(s) > load; });
    const double last =
        first_point(first, std::max(first, end_), [&](double s) { return slope(s) > load; });
    const double left = energy(first) - energy(last) + load * (last - first);
    return std::sqrt(first * first + 2.0 * std::max(left, 0.0) / mu) / h;
  }

 private:
  struct Term {
    double stiffness;
    double d;
    double rate;
    double own;
    double xi;
    double d_hat;
  };

  double energy(double s) const {
    double sum = 0.0;
    for (const Term& t : terms_) {
      if (t.rate == 0.0) continue;
      const double d = t.d + s * t.rate;
      sum += t.own / t.rate * t.stiffness * contact::barrier(d * d, t.xi, t.d_hat);
    }
    return sum;
  }

  /// dE/ds; infinite where surfaces would touch.
  double slope(double s) const {
    double sum = 0.0;
    for (const Term& t : terms_) {
      const double d = t.d + s * t.rate;
      if (d <= t.xi) return std::numeric_limits<double>::infinity();
      if (d >= t.xi + t.d_hat) continue;
      const double b1 = contact::barrier_derivatives(d * d, t.xi, t.d_hat).b1;
      sum += t.stiffness * b1 * 2.0 * d * t.own;
    }
    return sum;
  }

  std::vector<Term> terms_;
  double end_ = 0.0;  // value of s at which all separating contacts are out of reach
};

/// The courses of the owners that the contacts of two surfaces move along a change of all points.
std::map<Index, Course> courses_of(std::span<const Contact> contacts,
                                   const Owners& owners,
                                   const Array& dx,
                                   double d_hat) {
  std::map<Index, Course> courses;
  std::map<Index, double> rates;
  for (const Contact& c : contacts) {
    rates.clear();
    double rate = 0.0;
    for (int i = 0; i < 4; ++i) {
      const Index v = c.pair.vertices[i];
      const double of_corner =
          c.closest.c[i] * c.closest.t.dot(row(dx.data(), v)) / std::sqrt(c.closest.d_sq);
      rate += of_corner;
      if (of_corner != 0.0) rates[owners.of_vertex(v)] += of_corner;
    }
    for (const auto& [which, own] : rates) courses[which].add(c, rate, own, d_hat);
  }
  return courses;
}

/// The largest motion of a vertex of each owner in a change of all points.
std::map<Index, double> lengths_of(const Scene& scene, const Owners& owners, const Array& dx) {
  std::map<Index, double> lengths;
  for (Index v = 0; v < scene.vertex_count(); ++v) {
    const double length = row(dx.data(), v).norm();
    if (length == 0.0) continue;
    double& largest = lengths[owners.of_vertex(v)];
    largest = std::max(largest, length);
  }
  return lengths;
}

}  // namespace

std::optional<Throw> find_throw(const Scene& scene, const Inputs& inputs) {
  Problem p(scene, inputs);
  if (!p.contact) return {};
  contact::ContactModel& model = *p.contact;
  const double* const x = p.start.data();
  contact::Detection detection(scene.broad_phase);
  contact::ContactPotential barrier(model, detection, nullptr);
  barrier.look_at(x);
  const auto is_apart = [](const Contact& c) { return std::isfinite(c.barrier.b); };
  if (barrier.contacts().empty() || !std::ranges::all_of(barrier.contacts(), is_apart)) return {};
  const solver::Objective others =
      p.objective(p.inertia, p.cloth_potentials(), scene.elastic_patterns);
  others.stand_at(x);
  Array gradient;
  others.gradient(x, gradient);
  Stopwatch watch;
  solver::Counts counts;
  linalg::CholeskyWorkspace workspace;
  solver::LinearSystem system(others, workspace, watch, counts);
  const solver::Factor factor =
      system.factor_in_doubles(system.assemble(x, Curvature::kPositive, gradient));
  if (!factor) return {};
  barrier.add_gradient(x, gradient.data());
  Array all;
  p.coordinates.pull_back(gradient, all);
  const Owners owners(scene);
  const double d_hat = model.parameters().d_hat;
  std::optional<Throw> fastest;
  contact::for_each_pair(
      model, barrier.contacts(), [&](const auto&, const std::vector<Contact>& own) {
        // Forces with the signs of gradients, as in solve(), which returns the motion.
        Array push;
        Array dx;
        Array motion;
        gradient.assign(gradient.size(), 0.0);
        model.add_gradient(own, x, gradient.data());
        p.coordinates.pull_back(gradient, push);
        Array load = all;
        for (std::size_t k = 0; k < load.size(); ++k) load[k] -= push[k];
        system.solve(*factor, gradient, dx);
        p.coordinates.take_rows(dx, motion);
        auto pushed = owners.products(motion, push);
        auto loaded = owners.products(motion, load);
        const auto held = [&](Index which) {
          return pushed[which] < 0.0 ? std::clamp(-loaded[which] / pushed[which], 0.0, 1.0) : 1.0;
        };
        Array left = push;
        for (Index i = 0; i < owners.row_count(); ++i) {
          for (int k = 0; k < 3; ++k) left[3 * i + k] *= 1.0 - held(owners.of_row(i));
        }
        gradient.assign(gradient.size(), 0.0);
        p.coordinates.put_rows(left.data(), gradient);
        system.solve(*factor, gradient, dx);
        p.coordinates.take_rows(dx, motion);
        auto lengths = lengths_of(scene, owners, dx);
        auto works = owners.products(motion, push);
        double speed = 0.0;
        for (const auto& [which, course] : courses_of(own, owners, dx, d_hat)) {
          const double work = -works[which];
          const double mu = (1.0 - held(which)) * work;
          if (mu <= 0.0) continue;
          speed = std::max(speed, course.final_rate(mu, -held(which) * work, p.h) * lengths[which]);
        }
        if (speed == 0.0 || (fastest && speed <= fastest->speed)) return;
        const auto gap = [](const Contact& c) { return std::sqrt(c.closest.d_sq) - c.xi; };
        const Contact& nearest = *std::ranges::min_element(own, {}, gap);
        fastest = {.elements = describe_pair(scene, nearest.pair),
                   .gap = gap(nearest),
                   .barrier_distance = d_hat,
                   .speed = speed};
      });
  return fastest;
}

}  // namespace diffcloth::step
