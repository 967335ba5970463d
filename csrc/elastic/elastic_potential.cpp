#include "elastic/elastic_potential.h"

#include <algorithm>

namespace diffcloth::elastic {
namespace {

std::vector<double> negated(const double* z, Index vertex_count) {
  std::vector<double> result(z, z + 3 * static_cast<std::ptrdiff_t>(vertex_count));
  for (double& value : result) value = -value;
  return result;
}

}  // namespace

ElasticPotential::ElasticPotential(const Model& model,
                                   const Slots& slots,
                                   const linalg::BlockPattern& pattern,
                                   Wanted wanted)
    : model_(model),
      slots_(slots),
      wanted_(wanted),
      flat_bending_(ConstantForm::of_flat_bending(model, pattern)),
      change_(3 * static_cast<std::size_t>(model.topology->vertex_count)) {}

void ElasticPotential::renew() {
  flat_bending_ = ConstantForm::of_flat_bending(model_, flat_bending_.pattern());
  trial_ = {};
  known_ = {};
}

const BendingStates& ElasticPotential::bent_at(const double* x) const {
  const auto is_at = [&](const Known& known) {
    return !known.x.empty() && std::equal(known.x.begin(), known.x.end(), x);
  };
  if (model_.prepared->bent.batches.empty()) return known_[last_].bent;
  if (is_at(known_[last_])) return known_[last_].bent;
  last_ = 1 - last_;
  Known& here = known_[last_];
  if (is_at(here)) return here.bent;
  here.x.assign(x, x + change_.size());
  here.bent = bending_states(model_, x);
  return here.bent;
}

double ElasticPotential::energy_change(const double* x, const double* to) const {
  for (std::size_t a = 0; a < change_.size(); ++a) change_[a] = to[a] - x[a];
  trial_.x.assign(to, to + change_.size());
  trial_.gradient.assign(change_.size(), 0.0);
  const BendingStates& start = bent_at(x);
  Known& end = known_[1 - last_];
  end.x = trial_.x;
  double change = elastic::energy_change(model_, x, to, change_.data(), start, end.bent,
                                         trial_.gradient.data());
  if (model_.prepared->by_matrix) {
    change += flat_bending_.energy_change(x, change_.data());
    flat_bending_.add_product(to, trial_.gradient.data());
  }
  return change;
}

void ElasticPotential::add_gradient(const double* x, double* g) const {
  if (trial_.x.empty() || !std::equal(trial_.x.begin(), trial_.x.end(), x)) {
    trial_.x.assign(x, x + change_.size());
    trial_.gradient.assign(change_.size(), 0.0);
    elastic::add_gradient(model_, x, bent_at(x), trial_.gradient.data());
    if (model_.prepared->by_matrix) flat_bending_.add_product(x, trial_.gradient.data());
  }
  for (std::size_t a = 0; a < change_.size(); ++a) g[a] += trial_.gradient[a];
}

void ElasticPotential::add_hessian(const double* x,
                                   Curvature curvature,
                                   linalg::BlockMatrix& A) const {
  elastic::add_hessian(model_, slots_, x, bent_at(x), curvature, A.slot_of_base(), A.blocks());
}

void ElasticPotential::add_extrapolation(const double* x,
                                         Curvature curvature,
                                         linalg::BlockMatrix& A) const {
  elastic::add_extrapolation(model_, slots_, x, extrapolated_, curvature, A.slot_of_base(),
                             A.blocks());
}

void ElasticPotential::accumulate(const double* x, const double* z) {
  if (wanted_ == Wanted::kNone && !model_.prepared->has_damping) return;
  add_mixed(model_, x, negated(z, model_.topology->vertex_count).data(),
            wanted_ == Wanted::kMaterialsAndRest, bar());
}

void ElasticPotential::add_tangent(const double* x, double* y) const {
  elastic::add_tangent(model_, x, dot_, changing_, y);
}

void ElasticPotential::set_ahead_tangent(const std::vector<double>& ahead_dot) {
  dot_.ahead.assign(ahead_dot.begin(),
                    ahead_dot.begin() + static_cast<std::ptrdiff_t>(dot_.x_n.size()));
  changing_.start = true;
}

Bar& ElasticPotential::bar() {
  if (bar_.stretch.empty()) bar_ = Bar(*model_.topology, *model_.stencils);
  return bar_;
}

SpringPotential::SpringPotential(Springs springs, Index first_body, Index target_count)
    : stiffness_bar(static_cast<std::size_t>(springs.size()), 0.0),
      target_bar(3 * static_cast<std::size_t>(target_count), 0.0),
      springs_(springs),
      first_body_(first_body) {}

void SpringPotential::add_couplings(std::vector<std::pair<Index, Index>>& pairs) const {
  // Couplings between vertices of cloths are in the base pattern.
  for (Index a = 0; a < springs_.size(); ++a) {
    for (const Index i : springs_.points(a)) {
      if (i < first_body_) continue;
      for (const Index j : springs_.points(a)) {
        if (i != j && (j < first_body_ || j < i)) pairs.emplace_back(i, j);
      }
    }
  }
}

void SpringPotential::add_hessian(const double* x,
                                  Curvature curvature,
                                  linalg::BlockMatrix& A) const {
  std::vector<Mat3> changes;
  springs_.for_each_pulling([&](Index a) {
    changes.clear();
    for (const double b : springs_.coefficients(a)) changes.emplace_back(b * Mat3::Identity());
    A.add_congruence(springs_.points(a), changes,
                     hessian(springs_, a, x, curvature == Curvature::kPositive));
  });
}

void SpringPotential::add_left_out_products(const double* x,
                                            Curvature curvature,
                                            const Products& products) const {
  springs_.for_each_pulling([&](Index a) {
    const Mat3 core = hessian(springs_, a, x, curvature == Curvature::kPositive);
    const auto points = springs_.points(a);
    for (std::size_t l = 0; l < products.size(); ++l) {
      const Vec3 change = difference(springs_, a, products.z[l]);
      if (change.isZero(0.0)) continue;
      const Vec3 force = core * change;
      for (std::size_t p = 0; p < points.size(); ++p) {
        Eigen::Map<Vec3>(products.y[l] + 3 * points[p]) += springs_.coefficients(a)[p] * force;
      }
    }
  });
}

void SpringPotential::accumulate(const double* x, const double* z) {
  // Few points have a spring: change the sign of the contributions instead.
  std::vector<double> stiffness(stiffness_bar.size(), 0.0);
  std::vector<double> target(target_bar.size(), 0.0);
  add_mixed(springs_, x, z, stiffness.data(), target.data());
  for (std::size_t a = 0; a < stiffness.size(); ++a) stiffness_bar[a] -= stiffness[a];
  for (std::size_t a = 0; a < target.size(); ++a) target_bar[a] -= target[a];
}

}  // namespace diffcloth::elastic
