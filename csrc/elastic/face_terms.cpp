#include "elastic/face_terms.h"

#include "elastic/damping.h"
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

Mat32 damping_stress_change(
    const Model& model, Index f, const Mat32& F, const Mat32& F_n, const Mat32& G) {
  if (is_orthotropic(model, f)) {
    return orthotropic_damping::stress_change(damping_weave(model, f), F, F_n, G);
  }
  return damping::stress_change(damping_weight(model, f), F, F_n, G);
}

}  // namespace diffcloth::elastic
