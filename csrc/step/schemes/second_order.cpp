// The adjoint of a step of second order begins with the contact stage (contact_adjoint.cpp), whose
// shifted potentials yield the cotangent of the shift d,  d_bar = W''(x' - d) zhat.  With d = y - x_n
// and y the minimizer of
//
//   1/(2 h^2) |y - x_n - h v_n|^2_M + 1/2 (y - x_n)^T S(u) (y - x_n),
//
// d_bar is the g of the adjoint of this minimization, which has the same form. Its inputs are x_n, v_n,
// u, the ends of prescribed points, masses and stiffnesses. Tangents are propagated in reverse order.

#include "step/schemes/second_order.h"

#include <algorithm>
#include <memory>
#include <optional>
#include <utility>

#include "elastic/chord_strain.h"
#include "elastic/spring_rate.h"
#include "elastic/strain_rate.h"
#include "potential/shifted.h"
#include "solver/newton.h"
#include "step/potentials/air.h"
#include "step/potentials/attachments.h"
#include "step/potentials/elasticity.h"
#include "step/potentials/soft_pins.h"
#include "step/schemes/contact_stage.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// True if a point is a vertex with a prescribed end: a pin, or a vertex of a body with prescribed
/// motion.
bool follows_ends(const Problem& p, std::size_t point) {
  const auto vertices = static_cast<std::size_t>(p.scene.vertex_count());
  return point < vertices && p.scene.prescribed[point] != 0;
}

/// u: x_n + h v_n / 2 of free vertices of cloths; the mean of both ends of prescribed points.
Array middle(const Problem& p) {
  Array u = p.coasting();
  for (std::size_t a = 0; a < u.size(); ++a) u[a] = 0.5 * (u[a] + p.start[a]);
  return u;
}

/// Add cotangents of the positions at the end of the step to the cotangents of prescribed points.
void add_to_ends(const Problem& p, Array bar, Cotangents& bars) {
  p.coordinates.gather(p.ends, bar);
  for (std::size_t a = 0; a < bar.size(); ++a) {
    if (p.scene.prescribed[a / 3] != 0) bars.ends[a] += bar[a];
  }
}

/// Pull a cotangent of u back.
///
/// @param bar  of the cloths' points, or of all points
void pull_back_middle(const Problem& p, const Array& bar, Cotangents& bars) {
  Array ends_bar(p.start.size(), 0.0);
  for (std::size_t a = 0; a < bar.size(); ++a) {
    const bool prescribed = follows_ends(p, a / 3);
    bars.start[a] += prescribed ? 0.5 * bar[a] : bar[a];
    if (prescribed) ends_bar[a] = 0.5 * bar[a];
    if (!prescribed && a < p.cloth_size) bars.velocities[a] += 0.5 * p.h * bar[a];
  }
  add_to_ends(p, std::move(ends_bar), bars);
}

/// The tangent of u.
///
/// @param ends_dot  of all points
Array middle_tangent(const Problem& p, const Tangents& tangents, const Array& ends_dot) {
  const double* const v_dot = tangents.directions.data(Input::kVelocities);
  Array dot = tangents.start;
  for (std::size_t a = 0; a < dot.size(); ++a) {
    if (follows_ends(p, a / 3)) {
      dot[a] = 0.5 * (dot[a] + ends_dot[a]);
    } else if (a < p.cloth_size && v_dot != nullptr) {
      dot[a] += 0.5 * p.h * v_dot[a];
    }
  }
  return dot;
}

/// The first stage: the displacement of the cloths by their velocities, without the fast modes of
/// strain.
class Filter {
 public:
  explicit Filter(Problem& p)
      : p_(p),
        middle_(middle(p)),
        inertia_(p.masses, coasting(p), p.h),
        stretch_(p.find<Elasticity>().potential(),
                 p.scene.elastic_patterns.base(),
                 middle_.data(),
                 p.start.data()),
        attachments_(p.find<Attachments>().potential(), middle_, p.start),
        soft_pins_(p.find<SoftPins>().potential(), middle_, p.start),
        objective_(p.objective(
            inertia_, {&stretch_, &attachments_, &soft_pins_}, p.scene.elastic_patterns)) {}

  const solver::Objective& objective() const { return objective_; }

  /// All points at the end of the filter; none if rounding leaves no definite matrix.
  std::optional<Array> solve(const Forward& step) const {
    Array y = p_.coasting();
    objective_.stand_at(y.data());
    Array g;
    objective_.gradient(y.data(), g);
    solver::LinearSystem system(objective_, *step.context.workspace, *step.context.watch,
                                *step.context.counts);
    linalg::BlockMatrix matrix = system.assemble(y.data(), Curvature::kExact, g);
    // Positive definite by construction: no certificate is needed.
    solver::Certificate certificate{.factor = system.factor(matrix), .hessian = nullptr};
    if (!certificate.factor) return std::nullopt;
    if (certificate.factor->precision() == linalg::Precision::kSingle) {
      certificate.hessian = std::make_shared<const linalg::BlockValues>(std::move(matrix));
    }
    std::vector<Array> exact;
    system.solve(certificate, {g}, exact);
    for (std::size_t a = 0; a < p_.cloth_size; ++a) y[a] += exact.front()[a];
    step.kept.add(certificate);
    return y;
  }

  void swap_cotangents(CotangentStore& store) {
    inertia_.swap_cotangents(store);
    stretch_.swap_cotangents(store);
    attachments_.swap_cotangents(store);
    soft_pins_.swap_cotangents(store);
  }

  /// Pull back the cotangents of the filter's inputs; potentials of the step hold the cotangents of materials.
  void pull_back(Cotangents& bars) const {
    for (std::size_t a = 0; a < p_.cloth_size; ++a) {
      bars.start[a] += inertia_.target_bar[a] + stretch_.start_bar[a];
      bars.velocities[a] += p_.h * inertia_.target_bar[a];
    }
    for (std::size_t i = 0; i < bars.masses.size(); ++i) bars.masses[i] += inertia_.metric_bar[i];
    Array middle_bar = attachments_.middle_bar;
    for (std::size_t a = 0; a < middle_bar.size(); ++a) {
      bars.start[a] += attachments_.start_bar[a] + soft_pins_.start_bar[a];
      middle_bar[a] += soft_pins_.middle_bar[a];
      if (a < p_.cloth_size) middle_bar[a] += stretch_.middle_bar[a];
    }
    pull_back_middle(p_, middle_bar, bars);
  }

  /// Put the tangents of the filter's own inputs into its potentials.
  ///
  /// @param ends_dot  of all points
  void set_tangents(const Tangents& tangents, const Array& ends_dot) {
    const double* const v_dot = tangents.directions.data(Input::kVelocities);
    const auto velocity = [&](std::size_t a) { return v_dot != nullptr ? v_dot[a] : 0.0; };
    inertia_.metric_dot = tangents.masses;
    inertia_.target_dot.resize(p_.cloth_size);
    for (std::size_t a = 0; a < p_.cloth_size; ++a) {
      inertia_.target_dot[a] = tangents.start[a] + p_.h * velocity(a);
    }
    const Array middle_dot = middle_tangent(p_, tangents, ends_dot);
    stretch_.start_dot.assign(tangents.start.begin(),
                              tangents.start.begin() + static_cast<std::ptrdiff_t>(p_.cloth_size));
    stretch_.middle_dot = attachments_.middle_dot = soft_pins_.middle_dot = middle_dot;
    attachments_.start_dot = soft_pins_.start_dot = tangents.start;
  }

 private:
  static Array coasting(const Problem& p) {
    Array target = p.coasting();
    target.resize(p.cloth_size);
    return target;
  }

  Problem& p_;
  Array middle_;
  Proximity inertia_;
  elastic::StrainRate stretch_;
  elastic::SpringRate attachments_;
  elastic::SpringRate soft_pins_;
  solver::Objective objective_;
};

/// The second stage: the contact stage, with elasticity and springs evaluated at points minus the
/// displacement.
///
/// The strain of a face at x' is its strain at y = x' - d plus  sym(F(x' - d/2)^T F(d));  the filter has
/// left sym(F(u)^T F(d)) of it. Contact may lead x' - d/2 far from u in one step, so that the positions
/// x' are strained: the stage resists the difference e = sym(F(x' - d/2 - u)^T F(d)), by
/// elastic::ChordStrain. In smooth motion e is of third order in h.
class ShiftedStage {
 public:
  /// @param y  all points at the end of the filter; outlives this
  ShiftedStage(Problem& p, const Array& y)
      : p_(p),
        shift_(p.start.size(), 0.0),
        guess_(p.inertia.target()),
        middle_(middle(p)),
        elastic_(p.find<Elasticity>().potential(), shift_),
        attachments_(p.find<Attachments>().potential(), shift_),
        soft_pins_(p.find<SoftPins>().potential(), shift_),
        chords_(p.find<Elasticity>().potential(), shift_.data(), middle_.data()) {
    for (std::size_t a = 0; a < shift_.size(); ++a) {
      if (a < p.cloth_size || follows_ends(p, a / 3)) shift_[a] = y[a] - p.start[a];
    }
    // Inertia leads to x_n + h v_n; strain absorbs the difference to y.
    const Array coasting = p.coasting();
    for (std::size_t a = 0; a < p.cloth_size; ++a) {
      guess_[a] += y[a] - coasting[a];
      middle_[a] += 0.5 * shift_[a];
    }
    p.find<Elasticity>().predict(p, y.data());
  }

  ContactStage stage() {
    return {
        .inertia = p_.inertia,
        .guess = guess_.data(),
        .others = {&elastic_, &p_.find<Air>().potential(), &attachments_, &soft_pins_, &chords_},
        .patterns = p_.scene.elastic_patterns,
        .first_factor = 1,
        .attachments = &attachments_,
        .exchange = {},
        .set_tangents = {}};
  }

  void swap_cotangents(CotangentStore& store) {
    elastic_.swap_cotangents(store);
    attachments_.swap_cotangents(store);
    soft_pins_.swap_cotangents(store);
    chords_.swap_cotangents(store);
  }

  /// Pull the cotangent of the shift back to the start and to prescribed ends. Returns the cotangent of
  /// y, by row.
  Array pull_back(Cotangents& bars) const {
    Array bar(shift_.size(), 0.0);
    for (const Shifted* potential : {&elastic_, &attachments_, &soft_pins_}) {
      for (std::size_t a = 0; a < potential->shift_bar.size(); ++a)
        bar[a] += potential->shift_bar[a];
    }
    for (std::size_t a = 0; a < p_.cloth_size; ++a) {
      bar[a] += chords_.shift_bar[a] + 0.5 * chords_.center_bar[a];
    }
    pull_back_middle(p_, chords_.center_bar, bars);
    Array rows(p_.coordinates.size(), 0.0);
    Array ends_bar(bar.size(), 0.0);
    for (std::size_t a = 0; a < bar.size(); ++a) {
      if (a < p_.cloth_size) {
        rows[a] = bar[a];
      } else if (follows_ends(p_, a / 3)) {
        ends_bar[a] = bar[a];
      } else {
        continue;
      }
      bars.start[a] -= bar[a];
    }
    add_to_ends(p_, std::move(ends_bar), bars);
    const elastic::Bar& model = p_.find<Elasticity>().potential().bar();
    for (std::size_t a = 0; a < p_.cloth_size; ++a) rows[a] += model.ahead[a];
    return rows;
  }

  /// Put a tangent of the shift into the potentials, which hold the other tangents already.
  ///
  /// @param y_dot     of all points
  /// @param ends_dot  likewise
  void set_tangents(const Tangents& tangents, const Array& y_dot, const Array& ends_dot) {
    Array dot(shift_.size(), 0.0);
    for (std::size_t a = 0; a < dot.size(); ++a) {
      if (a < p_.cloth_size) {
        dot[a] = y_dot[a] - tangents.start[a];
      } else if (follows_ends(p_, a / 3)) {
        dot[a] = ends_dot[a] - tangents.start[a];
      }
    }
    p_.find<Elasticity>().potential().set_ahead_tangent(y_dot);
    chords_.center_dot = middle_tangent(p_, tangents, ends_dot);
    for (std::size_t a = 0; a < dot.size(); ++a) chords_.center_dot[a] += 0.5 * dot[a];
    chords_.shift_dot = dot;
    elastic_.shift_dot = attachments_.shift_dot = soft_pins_.shift_dot = std::move(dot);
  }

 private:
  Problem& p_;
  Array shift_;  ///< d
  Array guess_;
  Array middle_;  ///< u + d / 2 of the cloths
  Shifted elastic_;
  Shifted attachments_;
  Shifted soft_pins_;
  elastic::ChordStrain chords_;
};

/// All points at the end of a step's filter, from the tape.
Array filtered(const Taken& step) {
  Array y = step.problem.coasting();
  std::copy_n(step.tape["filter"], step.problem.cloth_size, y.begin());
  return y;
}

}  // namespace

std::vector<Field> SecondOrder::tape(const Scene& scene) const {
  std::vector<Field> fields = ContactStage::tape(scene);
  fields.push_back(
      {.name = "filter", .shape = {static_cast<std::size_t>(scene.cloth_vertex_count()), 3}});
  return fields;
}

void SecondOrder::forward(const Forward& step, Array& x, const Forces& forces) const {
  Problem& problem = step.problem;
  const std::optional<Array> y = Filter(problem).solve(step);
  if (!y) {
    solver::Outcome failed;
    failed.criterion = solver::Criterion::kIndefinite;
    failed.motion_fraction = 0.0;
    merge(failed, step.report);
    return;
  }
  if (!step.tape.empty()) std::copy_n(y->begin(), problem.cloth_size, step.tape["filter"]);
  ShiftedStage(problem, *y).stage().forward(step, x, forces);
}

void SecondOrder::backward(const Backward& step) const {
  Problem& problem = step.problem;
  const Array y = filtered(step);
  Filter filter(problem);
  ShiftedStage shifted(problem, y);
  std::vector<CotangentStore> own(step.losses.size());
  ContactStage contact = shifted.stage();
  contact.exchange = [&](std::size_t l) {
    step.losses[l].exchange(problem);
    own[l].begin();
    shifted.swap_cotangents(own[l]);
    filter.swap_cotangents(own[l]);
  };
  std::vector<Array> g;
  for (const Cotangents& bars : step.losses) g.push_back(bars.rows);
  contact.backward(step, g);
  for (std::size_t l = 0; l < g.size(); ++l) {
    const Turn turn(contact.exchange, l);
    g[l] = shifted.pull_back(step.losses[l]);
  }
  const solver::Objective& f = filter.objective();
  f.stand_at(y.data());
  pull_back_solve(step, f, y, step.kept.certificate(0), g, false, {}, contact.exchange);
  for (std::size_t l = 0; l < g.size(); ++l) {
    const Turn turn(contact.exchange, l);
    filter.pull_back(step.losses[l]);
  }
}

std::vector<Array> SecondOrder::tangent(const Pushforward& step) const {
  Problem& problem = step.problem;
  const Array y = filtered(step);
  Filter filter(problem);
  ShiftedStage shifted(problem, y);
  std::vector<Array> ends_dot;
  for (const Tangents& tangents : step.directions) {
    ends_dot.push_back(tangents.ends);
    problem.coordinates.carry(problem.ends, ends_dot.back());
  }
  const solver::Objective& f = filter.objective();
  f.stand_at(y.data());
  const std::vector<Array> y_dot =
      push_forward_solve(step, f, y, step.kept.certificate(0), false, {}, [&](std::size_t l) {
        step.directions[l].push_forward(problem);
        filter.set_tangents(step.directions[l], ends_dot[l]);
      });
  ContactStage contact = shifted.stage();
  contact.set_tangents = [&](std::size_t l) {
    step.directions[l].push_forward(problem);
    shifted.set_tangents(step.directions[l], y_dot[l], ends_dot[l]);
  };
  return contact.tangent(step);
}

}  // namespace diffcloth::step
