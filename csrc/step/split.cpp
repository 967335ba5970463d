// The adjoint of `split` is that of its contact stage (contact_stage.cpp), whose target is x^D; the
// cotangent of x^D is the g of one more adjoint of the same form, that of the elastic stage: the
// paper's Eqs. 8 and 29 with all explicit terms.

#include "step/split.h"

#include <algorithm>
#include <optional>
#include <utility>

#include "elastic/elastic_nearness.h"
#include "step/contact_stage.h"
#include "step/elastic_stage.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Nearness to x^D, in the metric G of the contact stage.
///
/// `elastic` is G = h^2 A with A = M/h^2 + L the constant matrix of the whole elastic stage, soft pins
/// and damping included: what contact pushes then pulls along what it hangs on, as it would in one
/// solve with that matrix for a Hessian. L annihilates constants, so that a free cloth keeps its
/// momentum as it does in the masses alone.
class Nearness {
 public:
  Nearness(Problem& problem, const Array& x_d)
      : problem_(problem), inertial_(diagonal(problem), x_d, problem.h) {
    if (problem.scene.given.metric != Metric::kElastic) return;
    elastic_.emplace(problem.constant_form(), problem.elasticity,
                     problem.anchors ? &*problem.anchors : nullptr, x_d);
  }

  ContactStage stage() {
    const Scene& scene = problem_.scene;
    std::vector<Potential*> others;
    if (elastic_) others.push_back(&*elastic_);
    return {.inertia = inertial_,
            .others = std::move(others),
            .assemblies = elastic_ ? scene.elastic_assemblies : scene.diagonal_assemblies,
            .first_factor = 1,
            .exchange = {}};
  }

  /// What the potentials accumulate for a loss: nothing yet.
  struct Bar {
    Array metric, target, elastic_target;
  };
  Bar zero_bar() const {
    return {.metric = Array(inertial_.metric_bar.size(), 0.0),
            .target = Array(inertial_.target_bar.size(), 0.0),
            .elastic_target = Array(elastic_ ? elastic_->target_bar.size() : 0, 0.0)};
  }
  void exchange(Bar& bar) {
    std::swap(inertial_.metric_bar, bar.metric);
    std::swap(inertial_.target_bar, bar.target);
    if (elastic_) std::swap(elastic_->target_bar, bar.elastic_target);
  }

  /// Cotangent of x^D.
  Array target_bar() const {
    Array bar = inertial_.target_bar;
    if (!elastic_) return bar;
    for (std::size_t a = 0; a < bar.size(); ++a) bar[a] += elastic_->target_bar[a];
    return bar;
  }

  /// Into the cotangents of the masses that G is made of.
  void add_masses_bar(Array& masses_bar) const {
    const Array& bar = inertial_.metric_bar;
    double mean = 0.0;
    for (const double value : bar) mean += value;
    mean /= static_cast<double>(bar.size());
    for (std::size_t i = 0; i < bar.size(); ++i) {
      masses_bar[i] += problem_.scene.given.metric == Metric::kIdentity ? mean : bar[i];
    }
  }

 private:
  /// G less h^2 L, which is diagonal [kg].
  static Array diagonal(const Problem& p) {
    if (p.scene.given.metric != Metric::kIdentity) return p.masses;
    // The literal metric weighs all vertices alike; the mean mass keeps the energy in joules.
    double mean = 0.0;
    for (const double m : p.masses) mean += m;
    mean /= static_cast<double>(p.masses.size());
    Array metric(p.masses.size(), mean);
    return metric;
  }

  Problem& problem_;
  Proximity inertial_;
  std::optional<elastic::ElasticNearness> elastic_;
};

}  // namespace

std::vector<Field> Split::tape(const Scene& scene) const {
  std::vector<Field> fields = ContactStage::tape(scene);
  fields.push_back(
      {.name = "elastic", .shape = {static_cast<std::size_t>(scene.cloth_vertex_count()), 3}});
  return fields;
}

void Split::forward(const Forward& step, Array& x, double* body_forces) const {
  Problem& problem = step.problem;
  Array x_d = ElasticStage(problem).forward(step, body_forces);
  x_d.resize(problem.cloth_size);
  Nearness(problem, x_d).stage().forward(step, x, body_forces);
}

void Split::backward(const Backward& step) const {
  Problem& problem = step.problem;
  const double* x_d = step.tape["elastic"];
  Nearness nearness(problem, Array(x_d, x_d + problem.cloth_size));
  std::vector<Nearness::Bar> own(step.losses.size(), nearness.zero_bar());
  ContactStage contact = nearness.stage();
  contact.exchange = [&](std::size_t l) {
    step.losses[l].exchange(problem);
    nearness.exchange(own[l]);
  };
  std::vector<Array> g;
  for (const Cotangents& bars : step.losses) g.push_back(bars.rows);
  contact.backward(step, g);

  for (std::size_t l = 0; l < g.size(); ++l) {
    const Turn turn(contact.exchange, l);
    nearness.add_masses_bar(step.losses[l].masses);
    g[l] = nearness.target_bar();
    g[l].resize(problem.coordinates.size(), 0.0);
  }
  ElasticStage(problem).backward(step, g);
}

}  // namespace diffcloth::step
