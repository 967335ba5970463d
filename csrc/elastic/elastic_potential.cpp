#include "elastic/elastic_potential.h"

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

double ElasticPotential::energy_change(const double* x, const double* to) const {
  for (std::size_t a = 0; a < change_.size(); ++a) change_[a] = to[a] - x[a];
  double change = elastic::energy_change(model_, x, to);
  if (model_.prepared.by_matrix) change += flat_bending_.energy_change(x, change_.data());
  return change;
}

void ElasticPotential::add_gradient(const double* x, double* g) const {
  elastic::add_gradient(model_, x, g);
  if (model_.prepared.by_matrix) flat_bending_.add_product(x, g);
}

void ElasticPotential::add_hessian(const double* x,
                                   Curvature curvature,
                                   linalg::BlockMatrix& A) const {
  elastic::add_hessian(model_, slots_, x, curvature, A.slot_of_base(), A.blocks());
}

void ElasticPotential::add_extrapolation(const double* x,
                                         Curvature curvature,
                                         linalg::BlockMatrix& A) const {
  elastic::add_extrapolation(model_, slots_, x, extrapolated_, curvature, A.slot_of_base(),
                             A.blocks());
}

void ElasticPotential::accumulate(const double* x, const double* z) {
  if (wanted_ == Wanted::kNone && !model_.prepared.damped) return;
  add_mixed(model_, x, negated(z, model_.topology->vertex_count).data(),
            wanted_ == Wanted::kMaterialsAndRest, bar());
}

Bar& ElasticPotential::bar() {
  if (bar_.stretch.empty()) bar_ = Bar(*model_.topology, *model_.stencils);
  return bar_;
}

AnchorPotential::AnchorPotential(Anchors anchors)
    : stiffness_bar(anchors.vertex.size(), 0.0),
      target_bar(3 * anchors.vertex.size(), 0.0),
      anchors_(anchors) {}

void AnchorPotential::add_hessian(const double* /*x*/,
                                  Curvature /*curvature*/,
                                  linalg::BlockMatrix& A) const {
  for (std::size_t a = 0; a < anchors_.vertex.size(); ++a) {
    A.add_to_diagonal(anchors_.vertex[a], anchors_.stiffness[a]);
  }
}

void AnchorPotential::accumulate(const double* x, const double* z) {
  // Few of the vertices have a soft pin: turn the sign of what is added instead.
  std::vector<double> stiffness(stiffness_bar.size(), 0.0);
  std::vector<double> target(target_bar.size(), 0.0);
  add_mixed(anchors_, x, z, stiffness.data(), target.data());
  for (std::size_t a = 0; a < stiffness.size(); ++a) stiffness_bar[a] -= stiffness[a];
  for (std::size_t a = 0; a < target.size(); ++a) target_bar[a] -= target[a];
}

}  // namespace diffcloth::elastic
