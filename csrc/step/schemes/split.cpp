// The adjoint of `split` begins with its contact stage (contact_adjoint.cpp), whose target is x^D. The
// cotangent of x^D is the g of the adjoint of the elastic stage, which has the same form: the paper's
// Eqs. 8 and 29 with all explicit terms. In the metric `energy` it is zero, unless nodes touch. Tangents
// are propagated in reverse order: the tangent of x^D is an input of the contact stage.

#include "step/schemes/split.h"

#include <algorithm>
#include <optional>
#include <utility>

#include "elastic/elastic_nearness.h"
#include "potential/tilt.h"
#include "step/potentials/attachments.h"
#include "step/potentials/constant_form.h"
#include "step/potentials/elasticity.h"
#include "step/schemes/contact_stage.h"
#include "step/schemes/elastic_stage.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Nearness to x^D: the objective of the contact stage without barrier and friction.
///
/// `energy` is  P(x) - P(x^D) - grad P(x^D) (x - x^D),  P inertia and elasticity, soft pins and damping
/// included: its excess over the elastic stage's minimum, in joules. The other metrics are  1/2 |x -
/// x^D|^2  in a matrix G / h^2: the masses, the identity, or, in `elastic`, h^2 A with A = M/h^2 + L the
/// constant matrix of the whole elastic stage. L annihilates constants, so that a free cloth keeps its
/// momentum as with the masses alone; but it resists rotations by  k_s |R - R^D|^2 / 2.  Let an element
/// turn by b over the step, and by a from x^D: these forces then do work -k_s a b on it. This work is a
/// gain wherever x^D is ahead, and exceeds all other terms if a stiff sheet turns far in a step. Every
/// constant matrix has this defect: one that does not resist rotations to first order strains by  a^2 /
/// 2.
class Nearness {
 public:
  /// @param tilted  true if x^D leaves forces that P does not have: those at nodes in contact; else grad
  ///                P(x^D) is zero up to the elastic stage's tolerance
  Nearness(Problem& problem, Array x_d, bool tilted) : problem_(problem), x_d_(std::move(x_d)) {
    switch (problem.scene.given.metric) {
      case Metric::kEnergy:
        if (tilted) tilt_.emplace(gradient_at_target());
        return;
      case Metric::kElastic:
        elastic_.emplace(constant_form(problem), problem.find<Elasticity>().potential(),
                         springs(problem), x_d_);
        inertial_.emplace(problem.masses, x_d_, problem.h);
        return;
      case Metric::kMass:
        inertial_.emplace(problem.masses, x_d_, problem.h);
        return;
      case Metric::kIdentity:
        inertial_.emplace(Array(problem.masses.size(), mean(problem.masses)), x_d_, problem.h);
        return;
    }
    __builtin_unreachable();
  }

  /// True if the nearness changes with x^D.
  static bool follows_target(const Problem& problem, bool tilted) {
    return tilted || problem.scene.given.metric != Metric::kEnergy;
  }

  ContactStage stage() {
    const Scene& scene = problem_.scene;
    std::vector<Potential*> others;
    if (!inertial_) others = problem_.cloth_potentials();
    if (elastic_) others.push_back(&*elastic_);
    if (tilt_) others.push_back(&*tilt_);
    const bool is_diagonal = inertial_ && !elastic_;
    return {.inertia = inertial_ ? *inertial_ : problem_.inertia,
            .guess = x_d_.data(),
            .others = std::move(others),
            .patterns = is_diagonal ? scene.diagonal_patterns : scene.elastic_patterns,
            .first_factor = 1,
            .attachments = &problem_.find<Attachments>().potential(),
            .exchange = {},
            .set_tangents = {}};
  }

  /// Swap the cotangents of the nearness's own potentials.
  void swap_cotangents(CotangentStore& store) {
    store.begin();
    if (inertial_) inertial_->swap_cotangents(store);
    if (elastic_) elastic_->swap_cotangents(store);
    if (tilt_) tilt_->swap_cotangents(store);
  }

  /// Put the tangents of the nearness's own potentials into them; P has its tangents already.
  ///
  /// @param x_d_dot  tangent of x^D, at all points
  void set_tangents(const Tangents& tangents, const Array& x_d_dot) {
    const Array target(x_d_dot.begin(), x_d_dot.begin() + static_cast<std::ptrdiff_t>(x_d_.size()));
    if (inertial_) {
      const bool is_uniform = problem_.scene.given.metric == Metric::kIdentity;
      inertial_->metric_dot =
          is_uniform ? Array(tangents.masses.size(), mean(tangents.masses)) : tangents.masses;
      inertial_->target_dot = target;
    }
    if (elastic_) elastic_->target_dot = target;
    if (tilt_) tilt_->force_dot = gradient_tangent(target);
  }

  /// Cotangent of x^D; adds the cotangents of masses and of P to their owners.
  Array pull_back(Cotangents& bars) {
    Array bar(problem_.cloth_size, 0.0);
    if (inertial_) {
      add_masses_bar(inertial_->metric_bar, bars.masses);
      bar = inertial_->target_bar;
    }
    if (elastic_) {
      for (std::size_t a = 0; a < bar.size(); ++a) bar[a] += elastic_->target_bar[a];
    }
    if (tilt_) pull_back_tilt(tilt_->force_bar, bar);
    return bar;
  }

 private:
  static double mean(const Array& values) {
    double sum = 0.0;
    for (const double value : values) sum += value;
    return sum / static_cast<double>(values.size());
  }

  template <class Visit>
  void for_each_of_energy(Visit&& visit) const {
    visit(static_cast<Potential&>(problem_.inertia));
    for (Potential* p : problem_.cloth_potentials()) visit(*p);
  }

  Array gradient_at_target() const {
    Array g(x_d_.size(), 0.0);
    for_each_of_energy([&](const Potential& p) { p.add_gradient(x_d_.data(), g.data()); });
    return g;
  }

  Array gradient_tangent(const Array& x_d_dot) const {
    Array change(x_d_.size(), 0.0);
    for_each_of_energy([&](const Potential& p) {
      p.add_hessian_product(x_d_.data(), x_d_dot.data(), change.data());
      p.add_tangent(x_d_.data(), change.data());
    });
    return change;
  }

  // f = grad P(x^D):  x^D gets H f_bar, and the inputs of P  d/d theta (f_bar . grad P).
  void pull_back_tilt(const Array& force_bar, Array& target_bar) {
    Array minus = force_bar;
    for (double& value : minus) value = -value;
    for_each_of_energy([&](Potential& p) {
      p.add_hessian_product(x_d_.data(), force_bar.data(), target_bar.data());
      p.accumulate(x_d_.data(), minus.data());
    });
  }

  /// Add to the cotangents of the masses in G.
  void add_masses_bar(const Array& bar, Array& masses_bar) const {
    const bool is_uniform = problem_.scene.given.metric == Metric::kIdentity;
    const double shared = is_uniform ? mean(bar) : 0.0;
    for (std::size_t i = 0; i < bar.size(); ++i) masses_bar[i] += is_uniform ? shared : bar[i];
  }

  Problem& problem_;
  Array x_d_;
  // The literal metric weighs all vertices alike; the mean mass keeps the energy in joules.
  std::optional<Proximity> inertial_;  ///< nearness in the diagonal matrix G - h^2 L [kg]
  std::optional<elastic::ElasticNearness> elastic_;
  std::optional<Tilt> tilt_;
};

}  // namespace

std::vector<Field> Split::tape(const Scene& scene) const {
  std::vector<Field> fields = ContactStage::tape(scene);
  fields.push_back(
      {.name = "elastic", .shape = {static_cast<std::size_t>(scene.cloth_vertex_count()), 3}});
  return fields;
}

void Split::forward(const Forward& step, Array& x, const Forces& forces) const {
  Problem& problem = step.problem;
  const ElasticStage elastic(problem);
  // Nearness in energy also holds the pins against all potentials of the elastic stage.
  Array unused(3 * problem.scene.given.pins.size());
  Forces elastic_forces = forces;
  if (!Nearness::follows_target(problem, elastic.has_contacts()))
    elastic_forces.pins = unused.data();
  Array x_d = elastic.forward(step, elastic_forces);
  x_d.resize(problem.cloth_size);
  Nearness(problem, std::move(x_d), elastic.has_contacts()).stage().forward(step, x, forces);
}

void Split::backward(const Backward& step) const {
  Problem& problem = step.problem;
  const double* x_d = step.tape["elastic"];
  const ElasticStage elastic(problem);
  Nearness nearness(problem, Array(x_d, x_d + problem.cloth_size), elastic.has_contacts());
  std::vector<CotangentStore> own(step.losses.size());
  ContactStage contact = nearness.stage();
  contact.exchange = [&](std::size_t l) {
    step.losses[l].exchange(problem);
    nearness.swap_cotangents(own[l]);
  };
  std::vector<Array> g;
  for (const Cotangents& bars : step.losses) g.push_back(bars.rows);
  contact.backward(step, g);
  if (!Nearness::follows_target(problem, elastic.has_contacts())) return;

  for (std::size_t l = 0; l < g.size(); ++l) {
    const Turn turn(contact.exchange, l);
    g[l] = nearness.pull_back(step.losses[l]);
    g[l].resize(problem.coordinates.size(), 0.0);
  }
  elastic.backward(step, g);
}

std::vector<Array> Split::tangent(const Pushforward& step) const {
  Problem& problem = step.problem;
  const double* x_d = step.tape["elastic"];
  const ElasticStage elastic(problem);
  Nearness nearness(problem, Array(x_d, x_d + problem.cloth_size), elastic.has_contacts());
  ContactStage contact = nearness.stage();
  std::vector<Array> x_d_dot;
  if (Nearness::follows_target(problem, elastic.has_contacts())) x_d_dot = elastic.tangent(step);
  contact.set_tangents = [&](std::size_t l) {
    step.directions[l].push_forward(problem);
    if (!x_d_dot.empty()) nearness.set_tangents(step.directions[l], x_d_dot[l]);
  };
  return contact.tangent(step);
}

}  // namespace diffcloth::step
