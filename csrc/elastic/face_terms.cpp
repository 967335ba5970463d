#include "elastic/face_terms.h"

#include "elastic/elements.h"
#include "elastic/orthotropic_damping.h"
#include "elastic/orthotropic_stretch.h"
#include "elastic/stretch.h"

namespace diffcloth::elastic {
namespace {

double damping_weight(const Model& model, Index f) {
  return model.damping[f] / model.h * stretch_weight(model, f);
}

}  // namespace

Weave stretch_weave(const Model& model, Index f) {
  if (is_orthotropic(model, f)) return weave(model, f).scaled(model.rest->area[f]);
  const double k = stretch_weight(model, f);
  return {.warp = k, .weft = k, .shear = k, .axis = Vec2::UnitX()};
}

Weave damping_weave(const Model& model, Index f) {
  return stretch_weave(model, f).scaled(model.damping[f] / model.h);
}

double stretch_energy(const Model& model, Index f, const Mat32& F) {
  if (is_orthotropic(model, f)) return orthotropic::energy(stretch_weave(model, f), F);
  return stretch::energy(stretch_weight(model, f), F);
}

Mat2 second_stress(const Model& model, Index f, const Mat32& F) {
  if (is_orthotropic(model, f)) return orthotropic::second_stress(stretch_weave(model, f), F);
  return stretch::second_stress(stretch_weight(model, f), F);
}

Mat32 stretch_stress_change(const Model& model, Index f, const Mat32& F, const Mat32& G) {
  if (is_orthotropic(model, f)) return orthotropic::stress_change(stretch_weave(model, f), F, G);
  return stretch::stress_change(stretch_weight(model, f), F, G);
}

damping::Start damping_start(const Model& model, Index f) {
  damping::Start start{
      .F_n = face_gradient(model, f, model.x_n), .F_a = Mat32::Zero(), .ahead = 0.0};
  if (model.ahead != nullptr) {
    start.F_a = face_gradient(model, f, model.ahead);
    start.ahead = damping::kAhead;
  }
  return start;
}

damping::Start damping_start_change(const Model& model,
                                    Index f,
                                    const Bar& dot,
                                    const Changing& changing) {
  damping::Start change{.F_n = Mat32::Zero(), .F_a = Mat32::Zero(), .ahead = 0.0};
  const auto add = [&](const double* x, const std::vector<double>& x_dot, Mat32& F_dot) {
    if (changing.start) F_dot += face_gradient(model, f, x_dot.data());
    if (changing.rest) F_dot += face_gradient(model, f, dot.rest.shape_gradient[f], x);
  };
  add(model.x_n, dot.x_n, change.F_n);
  if (model.ahead != nullptr) add(model.ahead, dot.ahead, change.F_a);
  return change;
}

void add_damping_start(
    const Model& model, Index f, const damping::Start& start_bar, bool with_rest, Bar& bar) {
  const auto add = [&](const double* x, const Mat32& F_bar, std::vector<double>& x_bar) {
    scatter(model, f, F_bar, x_bar.data());
    if (with_rest) scatter_gradient_bar(model, f, F_bar, x, bar.rest.shape_gradient[f]);
  };
  add(model.x_n, start_bar.F_n, bar.x_n);
  if (model.ahead != nullptr) add(model.ahead, start_bar.F_a, bar.ahead);
}

Mat32 damping_stress_change(
    const Model& model, Index f, const Mat32& F, const damping::Start& start, const Mat32& G) {
  if (is_orthotropic(model, f)) {
    return orthotropic_damping::stress_change(damping_weave(model, f), F, start, G);
  }
  return damping::stress_change(damping_weight(model, f), F, start, G);
}

}  // namespace diffcloth::elastic
