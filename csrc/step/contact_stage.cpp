// The adjoint of a step.
//
// Let E_k be the objective of friction iteration k = 1..K, x_k its minimizer over the free vertices,
// and grad the gradient over *all* vertices: free, pinned and bodies'. The outputs are x_K,
// v = (x_K - x_n)/h and the forces f_o = -grad_o E_K at fixed x_K (bodies' rows). For cotangents
// x_bar, v_bar, f_bar (forces on pins, grad_p E_K, have rows of zhat likewise, with the other sign; to
// those on the cloths' vertices, -grad of barrier and friction alone, the last lines come back):
//
//   g_K   = x_bar + v_bar / h
//   z_k   = H_k^-1 (g_k - H_xo f_bar [k = K])      at the free vertices
//   zhat  = (z_k, 0 at pins, f_bar at bodies [k = K, else 0])
//
// Then every input theta that E_k depends on, whether through the solution or through the forces,
// gets the same expression,
//
//   theta_bar -= d/d(theta) ( zhat . grad E_k ),
//
// which each potential adds up for its own inputs; in particular prescribed positions (pins c, bodies
// o) get  -(H zhat) at their rows, and pins also the direct g_k. Friction's displacement from x_start gives
// x_start_bar, or that of the origins where these are given. Contact forces with cotangent c_bar on
// the cloths' vertices are like another f_bar of the objective C = barrier + friction: g_K loses H_C c_bar,
// and C is pulled back at zhat + c_bar. The lag configuration of k is x_{k-1}
// (x_n for k = 1): its cotangent becomes g_{k-1}, and the sweep goes on from K to 1.
//
// Where vertices y(q, s) of links follow coordinates q and frames s, x stands for all of z = (cloth, q),
// dy = J dz, H includes the second derivative of  y . grad_y E_k  by q, and zhat has J z_k at those
// vertices besides f_bar. Prescribed joints and frames are like pins: of  zhat . grad E_k  they get
// -J_s^T (H zhat) and, as J itself depends on them,  -d/ds (J z_k) . grad_y E_k.

#include "step/contact_stage.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>

#include "solver/newton.h"
#include "step/attachments.h"
#include "step/motion.h"

namespace diffcloth::step {
namespace {

using contact::Contact;
using contact::ContactPotential;
using contact::FrictionPotential;
using Array = std::vector<double>;

/// The potentials of one friction iteration.
class Sum {
 public:
  /// @param bar          where friction accumulates; null where it never does
  /// @param barrier_bar  likewise, the barrier
  Sum(ContactStage& stage,
      Problem& problem,
      contact::Detection& detection,
      contact::ContactModel::Bar* bar,
      contact::ContactModel::Bar* barrier_bar)
      : stage_(stage), problem_(problem), bar_(bar) {
    if (problem.contact) contact_.emplace(*problem.contact, detection, barrier_bar);
    objective = problem.objective(stage.inertia, stage.others, stage.patterns);
    objective.contact = contact_ ? &*contact_ : nullptr;
  }

  /// Contacts at the start of a motion; the contact potential stands there.
  const std::vector<Contact>& contacts_at_start(const Array& x) {
    if (contact_) contact_->stand_at_start(x.data());
    return contacts();
  }

  /// Contacts at a point, found from scratch; the contact potential stands there.
  const std::vector<Contact>& contacts_at(const Array& x) {
    if (contact_) contact_->look_at(x.data());
    return contacts();
  }

  /// Stand where these are the contacts.
  void adopt(std::vector<Contact> contacts) {
    if (contact_) contact_->adopt(std::move(contacts));
  }

  /// Contacts where the contact potential stands.
  const std::vector<Contact>& contacts() const {
    static const std::vector<Contact> none;
    return contact_ ? contact_->contacts() : none;
  }

  /// The potentials that contact forces are of.
  std::vector<Potential*> touching() {
    std::vector<Potential*> potentials;
    if (objective.contact != nullptr) potentials.push_back(objective.contact);
    if (friction) potentials.push_back(&*friction);
    return potentials;
  }

  /// Contacts that friction is taken from.
  const std::vector<Contact>& lagged() const { return lagged_; }

  /// Let factors have the couplings of all contacts that there may be on the way from a point: patterns
  /// seldom change then, and remain functions of the point and this one.
  void expect_contacts_near(const Array& x) {
    if (!contact_) return;
    linalg::Couplings points;
    contact_->add_couplings_near(x.data(), points);
    objective.expect(std::move(points));
  }

  /// Take friction from the contacts of a configuration.
  void lag(const std::vector<Contact>& contacts) {
    objective.others = stage_.others;
    friction.reset();
    lagged_.clear();
    // Where nothing can touch there are no contacts either.
    if (!problem_.contact || contacts.empty()) return;
    friction.emplace(*problem_.contact, contacts, problem_.moved_from().data(), bar_);
    objective.others.push_back(&*friction);
    lagged_ = contacts;
  }

  solver::Objective objective;
  std::optional<FrictionPotential> friction;

 private:
  ContactStage& stage_;
  Problem& problem_;
  contact::ContactModel::Bar* bar_;
  std::optional<ContactPotential> contact_;
  std::vector<Contact> lagged_;
};

void report_contacts(const std::vector<Contact>& contacts, Report& report) {
  report.contact_count = static_cast<Index>(contacts.size());
  report.minimum_distance = std::numeric_limits<double>::infinity();
  for (const Contact& k : contacts) {
    report.minimum_distance = std::min(report.minimum_distance, std::sqrt(k.closest.d_sq));
  }
}

/// Name what is near each other where a step could not go on. Contacts do not tell: two surfaces that
/// are both prescribed have none, and block each other all the same.
void report_blockers(const Problem& problem,
                     const Array& x,
                     solver::Status status,
                     Report& report) {
  const bool is_infeasible = status == solver::Status::kInfeasibleMotion;
  if (!is_infeasible && status != solver::Status::kBlocked) return;
  std::string names;
  if (problem.contact) {
    const contact::Parameters& parameters = problem.contact->parameters();
    names = describe_near(problem.scene, x.data(), parameters.thickness, parameters.d_hat);
  }
  if (!is_infeasible) {
    report.message += ": " + names;
  } else if (names.empty()) {
    report.message = "nothing is in the way yet, but the iterations of the step are used up";
  } else {
    report.message = "in contact: " + names;
  }
}

/// Forces of contact on all vertices, minus the partial derivative of its energy, with those of
/// attachments on bodies, and forces on pins.
void add_forces(const Problem& problem, Sum& sum, const Array& x, const Forces& forces) {
  Array g(x.size(), 0.0);
  for (const Potential* p : sum.touching()) p->add_gradient(x.data(), g.data());
  const std::size_t end = 3 * static_cast<std::size_t>(problem.scene.vertex_count());
  for (std::size_t a = 0; a < problem.cloth_size; ++a) forces.contact[a] -= g[a];
  if (problem.scene.has_attached_bodies()) {
    problem.find<Attachments>().potential().add_gradient(x.data(), g.data());
  }
  for (std::size_t a = problem.cloth_size; a < end; ++a) {
    forces.bodies[a - problem.cloth_size] -= g[a];
  }
  add_pin_forces(problem, sum.objective, x, forces.pins);
}

std::string_view words(solver::Status status) {
  switch (status) {
    case solver::Status::kConverged:
    case solver::Status::kInfeasibleMotion:
      return {};
    case solver::Status::kIterationLimit:
      return "the iterations of the step are used up";
    case solver::Status::kRoundingFloor:
      return "rounding hides any further decrease: the floor of float64 for this scene";
    case solver::Status::kBlocked:
      return "surfaces are so close that rounding lets none of them move";
    case solver::Status::kSaddle:
      return "at a saddle, and no lower point was found from there";
    case solver::Status::kUnsolved:
      return "no solution of the law of friction at vertices was found";
  }
  __builtin_unreachable();
}

}  // namespace

void merge(const solver::Outcome& outcome, Report& report) {
  report.residual = std::max(report.residual, outcome.residual);
  report.motion_fraction = std::min(report.motion_fraction, outcome.motion_fraction);
  if (outcome.status == solver::Status::kInfeasibleMotion) {
    report.result = Result::kInfeasibleMotion;
  } else if (outcome.status != solver::Status::kConverged) {
    report.result = Result::kNotConverged;
    report.message = words(outcome.status);
  }
}

std::vector<Field> ContactStage::tape(const Scene& scene) {
  const std::size_t n = static_cast<std::size_t>(scene.cloth_vertex_count()) +
                        static_cast<std::size_t>(scene.mechanisms.node_count());
  const auto k = static_cast<std::size_t>(scene.given.friction_iterations);
  // Numbers of contacts, at the start and after each solve, spare backward the search for none.
  return {{.name = "iterates", .shape = {k, n, 3}},
          {.name = "solves", .shape = {1}},
          {.name = "contacts", .shape = {k + 1}}};
}

void ContactStage::forward(const Forward& step, Array& x, const Forces& forces) {
  Problem& problem = step.problem;
  const std::size_t size = problem.coordinates.size();
  const int friction_iterations = problem.scene.given.friction_iterations;
  Sum sum(*this, problem, step.detection, nullptr, nullptr);
  const GeodesicMotion motion(problem);
  const auto keep = [&](int k, const std::vector<Contact>& contacts) {
    if (step.tape.empty()) return;
    step.tape["contacts"][k] = static_cast<double>(contacts.size());
    step.kept.contacts.push_back(contacts);
  };
  const std::vector<Contact>& at_start = sum.contacts_at_start(x);
  keep(0, at_start);
  sum.lag(at_start);
  {
    const Stopwatch::Scope scope(*step.context.watch, Phase::kAnalysis);
    sum.expect_contacts_near(problem.start);
  }
  // Everything at its end, unknowns where inertia alone (or x^D) would put them.
  const Array first_guess = problem.predicted(guess);
  solver::Factor factor;
  int solves = 0;
  solver::Status status = solver::Status::kConverged;
  while (solves < friction_iterations) {
    const solver::Outcome outcome =
        solver::minimize(sum.objective, x, motion, solves == 0 ? &first_guess : nullptr,
                         std::move(factor), step.context);
    status = outcome.status;
    merge(outcome, step.report);
    step.kept.add(outcome.certificate);
    factor = outcome.certificate.factor;
    if (!step.tape.empty()) {
      Array rows;
      problem.coordinates.take_rows(x, rows);
      std::ranges::copy(rows, step.tape["iterates"] + solves * size);
    }
    ++solves;
    if (step.report.result != Result::kConverged) break;
    const std::vector<Contact>& contacts = sum.contacts();
    keep(solves, contacts);
    // Without contact before and after, another solve would be the same one.
    if (!sum.friction && contacts.empty()) break;
    if (solves < friction_iterations) sum.lag(contacts);
  }
  report_contacts(sum.contacts(), step.report);
  report_blockers(problem, x, status, step.report);
  const double reached = step.report.motion_fraction;
  if (reached < 1.0) step.report.root_poses = motion.root_poses(reached);
  if (!step.tape.empty()) *step.tape["solves"] = solves;
  add_forces(problem, sum, x, forces);
  PairTally(problem, step.report).add(sum.contacts(), sum.lagged(), x);
}

namespace {

bool is_zero(const Array& bar) {
  return std::ranges::all_of(bar, [](double value) { return value == 0.0; });
}

/// Cotangents of the forces that are a gradient of the whole objective, whose sign bodies feel turned.
///
/// @param with_bodies  whether the forces on bodies are among them
/// @param out          [points, 3], zero
/// @return whether there are any
bool read_held_forces(const Backward& step, std::size_t l, bool with_bodies, Array& out) {
  const Cotangents& bars = step.losses[l];
  const bool bodies = with_bodies && !is_zero(bars.body_forces);
  if (bodies) {
    std::ranges::copy(bars.body_forces,
                      out.begin() + static_cast<std::ptrdiff_t>(step.problem.cloth_size));
  }
  if (is_zero(bars.pin_forces)) return bodies;
  const std::vector<Index>& pins = step.problem.scene.given.pins;
  for (std::size_t p = 0; p < pins.size(); ++p) {
    for (std::size_t k = 0; k < 3; ++k) out[3 * pins[p] + k] = -bars.pin_forces[3 * p + k];
  }
  return true;
}

}  // namespace

void pull_back_solve(const Backward& step,
                     const solver::Objective& f,
                     const Array& x,
                     solver::Certificate certificate,
                     const std::vector<Array>& g,
                     bool with_forces,
                     const std::vector<Potential*>& touching,
                     const Turn::Exchange& exchange) {
  const solver::Coordinates& coordinates = *f.coordinates;
  const bool with_bodies = !touching.empty() || step.problem.scene.has_attached_bodies();
  solver::LinearSystem system(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  Array gradient;
  const bool is_kept = certificate.factor != nullptr;
  if (!is_kept || coordinates.is_curved()) f.gradient(x.data(), gradient);
  Array p;
  if (!is_kept) certificate = system.certify(x.data(), gradient, p);
  if (!certificate.factor)
    throw std::domain_error("the Hessian is not positive definite at the solution");

  std::vector<Array> b(g.size(), Array(x.size(), 0.0));
  std::vector<Array> forces = b;
  std::vector<Array> touched(g.size());
  Array product;
  for (std::size_t l = 0; l < g.size(); ++l) {
    coordinates.add_rows(g[l], b[l]);
    if (!with_forces) continue;
    if (read_held_forces(step, l, with_bodies, forces[l])) {
      f.hessian_product(x.data(), forces[l].data(), product);
      for (std::size_t a = 0; a < product.size(); ++a) b[l][a] -= product[a];
    }
    const Array& bar = step.losses[l].contact_forces;
    if (touching.empty() || is_zero(bar)) continue;
    touched[l] = bar;
    touched[l].resize(x.size(), 0.0);
    product.assign(x.size(), 0.0);
    for (const Potential* p : touching) {
      p->add_hessian_product(x.data(), touched[l].data(), product.data());
    }
    for (std::size_t a = 0; a < product.size(); ++a) b[l][a] -= product[a];
  }
  std::vector<Array> z;
  system.solve(certificate, b, z);

  for (std::size_t l = 0; l < g.size(); ++l) {
    step.context.checkpoint->check();
    Array& zhat = z[l];
    for (std::size_t a = 0; a < zhat.size(); ++a) zhat[a] = forces[l][a] - zhat[a];
    f.held_product(x.data(), zhat.data(), product);
    Array with_touched = zhat;
    if (!touched[l].empty()) {
      for (const Potential* p : touching) {
        p->add_held_product(x.data(), touched[l].data(), product.data());
      }
      for (std::size_t a = 0; a < zhat.size(); ++a) with_touched[a] += touched[l][a];
    }
    for (double& value : product) value = -value;
    coordinates.gather(x, product);
    if (coordinates.is_curved()) {
      coordinates.subtract_change(x, zhat, gradient, product);
    }
    coordinates.add_rows(g[l], product);
    Array& ends = step.losses[l].ends;
    for (Index i = 0; i < coordinates.point_count(); ++i) {
      if (coordinates.prescribed()[i] == 0) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) ends[a] += product[a];
    }
    const Turn turn(exchange, l);
    f.for_each([&](Potential& p) {
      const bool touches = std::ranges::find(touching, &p) != touching.end();
      p.accumulate(x.data(), (touches ? with_touched : zhat).data());
    });
  }
}

namespace {

/// The cotangent of where friction counts motion from.
void add_start(const Array& start_bar, Cotangents& bars) {
  Array& bar = bars.origins.empty() ? bars.start : bars.origins;
  for (std::size_t a = 0; a < start_bar.size(); ++a) bar[a] += start_bar[a];
}

/// The cotangent of the lag configuration: of the start, or of the rows g of the solve before.
void add_lag(const Problem& problem,
             const Array& x_lag,
             bool is_start,
             Array lag_bar,
             Cotangents& bars,
             Array& g) {
  if (is_start) {
    for (std::size_t a = 0; a < lag_bar.size(); ++a) bars.start[a] += lag_bar[a];
    return;
  }
  lag_bar.resize(x_lag.size(), 0.0);
  problem.coordinates.gather(x_lag, lag_bar);
  problem.coordinates.take_rows(lag_bar, g);
  // What is prescribed and no row: bodies and frames.
  problem.coordinates.clear_rows(lag_bar);
  for (std::size_t a = 0; a < lag_bar.size(); ++a) bars.ends[a] += lag_bar[a];
}

}  // namespace

void ContactStage::backward(const Backward& step, std::vector<Array> g) {
  Problem& problem = step.problem;
  const std::size_t size = problem.coordinates.size();
  // The tape has been in other hands: hooks on saved tensors may return anything.
  if (!(*step.tape["solves"] >= 1.0 &&
        *step.tape["solves"] <= problem.scene.given.friction_iterations)) {
    throw std::invalid_argument(
        "core: the tape must have one solve or more, and at most one a friction iteration");
  }
  const auto solves = static_cast<std::size_t>(*step.tape["solves"]);
  // What contact and friction accumulate, of the loss whose turn it is.
  contact::ContactModel::Bar contact_bar(problem.scene.collision_mesh);
  Sum sum(*this, problem, step.detection, &contact_bar, step.barrier ? &contact_bar : nullptr);
  std::vector<Array> start_bars(g.size());
  std::vector<Array> lag_bars(g.size());
  const Turn::Exchange exchange_all = [&](std::size_t l) {
    exchange(l);
    std::swap(contact_bar, step.losses[l].contact);
    if (!sum.friction) return;
    std::swap(sum.friction->start_bar, start_bars[l]);
    std::swap(sum.friction->lag_bar, lag_bars[l]);
  };
  const auto at = [&](std::size_t k) { return problem.at(step.tape["iterates"] + k * size); };
  const double* const counts = step.tape["contacts"];
  // Contacts at the start, k = 0, or where solve k has ended.
  const auto contacts_at = [&](std::size_t k, const Array& x) -> std::vector<Contact> {
    if (counts[k] == 0.0) return {};
    return k < step.kept.contacts.size() ? step.kept.contacts[k] : sum.contacts_at(x);
  };
  Array x_lag = at(solves - 1);
  std::vector<Contact> lag = contacts_at(solves, x_lag);
  for (std::size_t k = solves; k-- > 0;) {
    step.context.checkpoint->check();
    const Array x = std::move(x_lag);
    std::vector<Contact> contacts = std::move(lag);
    x_lag = k == 0 ? problem.start : at(k - 1);
    lag = contacts_at(k, x_lag);
    sum.lag(lag);
    if (sum.friction) sum.friction->set_lag(x_lag.data());
    sum.adopt(std::move(contacts));
    problem.coordinates.stand_at(x.data());
    const std::size_t place = first_factor + k;
    const auto& kept = step.kept.certificates;
    solver::Certificate certificate = place < kept.size() ? kept[place] : solver::Certificate{};
    // Of all solves the same.
    if (!certificate.factor && sum.objective.expected.empty())
      sum.expect_contacts_near(problem.start);
    pull_back_solve(step, sum.objective, x, std::move(certificate), g, k + 1 == solves,
                    sum.touching(), exchange_all);

    for (std::size_t l = 0; l < g.size(); ++l) {
      std::ranges::fill(g[l], 0.0);
      if (!sum.friction) continue;
      const Array start_bar = std::exchange(start_bars[l], {});
      add_start(start_bar, step.losses[l]);
      add_lag(problem, x_lag, k == 0, std::exchange(lag_bars[l], {}), step.losses[l], g[l]);
    }
  }
}

}  // namespace diffcloth::step
