#include "elastic/constant_form.h"

#include "elastic/bending.h"
#include "elastic/elements.h"
#include "elastic/form_numbers.h"

namespace diffcloth::elastic {
namespace {

/// 1 + k_d/h of a face: damping resists a change over the step as stretch resists a change from rest.
double face_factor(const Model& model, Index f) {
  return model.damping[f] == 0.0 ? 1.0 : 1.0 + model.damping[f] / model.h;
}

double element_factor(const Model& model, Index e) { return 1.0 + model.prepared->damping[e]; }

/// F diag(k_w, k_f) in material axes: warp and weft each resist changes of their own yarns. Shear adds
/// nothing, so that L is linear in the stiffnesses; if shear is no stiffer than the yarns, the Hessian
/// stays below L.
Mat32 constant_stress(const Weave& k, const Mat32& F) {
  const Mat2 Q = k.axes();
  return F * Q * Vec2(k.warp, k.weft).asDiagonal() * Q.transpose();
}

void add_woven_constant_mixed(
    const Model& model, Index f, const double* u, const double* z, bool with_rest, Bar& bar) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const double factor = face_factor(model, f);
  const Mat32 F_u = face_gradient(model, f, u);
  const Mat32 F_z = face_gradient(model, f, z);
  const Mat2 work = k.axes().transpose() * F_u.transpose() * F_z * k.axes();
  const double total = k.warp * work(0, 0) + k.weft * work(1, 1);
  bar.stretch[f] += area * factor * work(0, 0);
  bar.stretch_weft[f] += area * factor * work(1, 1);
  if (model.h > 0.0) bar.damping[f] += area / model.h * total;
  if (!with_rest) return;
  bar.rest.area[f] += factor * total;
  mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
  const Weave weight = k.scaled(area * factor);
  scatter_gradient_bar(model, f, constant_stress(weight, F_z), u, g_bar);
  scatter_gradient_bar(model, f, constant_stress(weight, F_u), z, g_bar);
}

void add_constant_mixed(
    const Model& model, Index f, const double* u, const double* z, bool with_rest, Bar& bar) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double factor = face_factor(model, f);
  const Mat32 F_u = face_gradient(model, f, u);
  const Mat32 F_z = face_gradient(model, f, z);
  const double work = F_u.cwiseProduct(F_z).sum();
  bar.stretch[f] += area * factor * work;
  if (model.h > 0.0) bar.damping[f] += k_s * area / model.h * work;
  if (!with_rest) return;
  bar.rest.area[f] += k_s * factor * work;
  mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
  scatter_gradient_bar(model, f, k_s * area * factor * F_z, u, g_bar);
  scatter_gradient_bar(model, f, k_s * area * factor * F_u, z, g_bar);
}

/// @param damped  true to include damping
void add_element_mixed(const Model& model,
                       Index e,
                       bool damped,
                       const double* u,
                       const double* z,
                       bool with_rest,
                       Bar& bar) {
  const double factor = damped ? element_factor(model, e) : 1.0;
  bending::Element element = differentiable_element(model, e);
  element.weight *= factor;
  double* const c_bar =
      with_rest ? bar.rest.curvature_operator.data() + 3 * model.stencils->start[e] : nullptr;
  const FormNumbers numbers(model, e);
  bending::ScalarBars scalar = bending::constant_mixed(element, numbers.derivatives(), u, z, c_bar);
  if (damped && model.h > 0.0) {
    const double stiffness = element_stiffness(model, e) * model.rest->bending_area[e];
    add_to_faces(model, e, scalar.weight * stiffness / model.h, bar.damping);
  }
  scalar.weight *= factor;
  add_weight_bars(model, e, scalar, with_rest, bar);
}

void add_woven_constant_tangent(const Model& model,
                                Index f,
                                const double* u,
                                const Bar& dot,
                                const Changing& changing,
                                double* y) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const double factor = face_factor(model, f);
  const Mat32 F_u = face_gradient(model, f, u);
  Weave change = k.scaled(0.0);
  if (changing.materials) {
    const double factor_dot = model.h > 0.0 ? dot.damping[f] / model.h : 0.0;
    change.warp += area * (factor * dot.stretch[f] + factor_dot * k.warp);
    change.weft += area * (factor * dot.stretch_weft[f] + factor_dot * k.weft);
  }
  Mat32 F_dot = Mat32::Zero();
  if (changing.rest) {
    change.warp += factor * dot.rest.area[f] * k.warp;
    change.weft += factor * dot.rest.area[f] * k.weft;
    F_dot = face_gradient(model, f, dot.rest.shape_gradient[f], u);
  }
  const Weave weight = k.scaled(area * factor);
  scatter(model, f, constant_stress(change, F_u) + constant_stress(weight, F_dot), y);
  if (changing.rest) {
    scatter(model, f, constant_stress(weight, F_u), dot.rest.shape_gradient[f], y);
  }
}

void add_constant_tangent(const Model& model,
                          Index f,
                          const double* u,
                          const Bar& dot,
                          const Changing& changing,
                          double* y) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double factor = face_factor(model, f);
  const mesh::ShapeGradient& g = model.rest->shape_gradient[f];
  const Mat32 F_u = face_gradient(model, f, u);
  double weight_dot = 0.0;
  if (changing.materials) {
    weight_dot += dot.stretch[f] * area * factor;
    if (model.h > 0.0) weight_dot += k_s * area * dot.damping[f] / model.h;
  }
  Mat32 change = weight_dot * F_u;
  if (changing.rest) {
    const mesh::ShapeGradient& g_dot = dot.rest.shape_gradient[f];
    const double weight = k_s * area * factor;
    change += k_s * factor * dot.rest.area[f] * F_u + weight * face_gradient(model, f, g_dot, u);
    scatter(model, f, weight * F_u, g_dot, y);
  }
  scatter(model, f, change, g, y);
}

void add_element_tangent(const Model& model,
                         Index e,
                         bool damped,
                         const double* u,
                         const Bar& dot,
                         const Changing& changing,
                         double* y) {
  const double factor = damped ? element_factor(model, e) : 1.0;
  bending::Element element = differentiable_element(model, e);
  const double stiffness = element.weight;
  element.weight *= factor;
  bending::Tangents tangents;
  if (changing.materials) {
    if (!is_plate(model, e)) {
      tangents.weight = element_mean(model, e, dot.bending) * factor * model.rest->bending_area[e];
    }
    tangents.form = FormNumbers(model, e).change(dot);
    if (damped && model.h > 0.0) {
      tangents.weight += element_mean(model, e, dot.damping) * stiffness / model.h;
    }
  }
  if (changing.rest) {
    tangents.weight += element_stiffness(model, e) * factor * dot.rest.bending_area[e];
    tangents.c = dot.rest.curvature_operator.data() + 3 * model.stencils->start[e];
  }
  bending::add_constant_tangent(element, u, tangents, y);
}

}  // namespace

ConstantForm ConstantForm::of_flat_bending(const Model& model,
                                           const linalg::BlockPattern& pattern) {
  return {pattern, model.topology->vertex_count, model.prepared->constant};
}

ConstantForm ConstantForm::of_bending(const Model& model,
                                      const Slots& slots,
                                      const linalg::BlockPattern& pattern) {
  ConstantForm form(pattern, model.topology->vertex_count, {});
  form.own_values_ = model.prepared->constant;
  form.values_ = form.own_values_;
  for (Index e = 0; e < model.stencils->size(); ++e) {
    const bending::Element element = bending_element(model, e);
    if (!element.flat) {
      bending::add_constant(element, bending_slots(slots, e), form.own_values_.data());
    }
  }
  return form;
}

ConstantForm::ConstantForm(const Model& model,
                           const Slots& slots,
                           std::span<const Springs> springs,
                           const linalg::BlockPattern& pattern)
    : pattern_(&pattern),
      vertex_count_(model.topology->vertex_count),
      own_values_(model.prepared->constant),
      values_(own_values_) {
  for (Index f = 0; f < face_count(model); ++f) {
    const mesh::ShapeGradient& g = model.rest->shape_gradient[f];
    const Index* slot = slots.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f);
    if (is_orthotropic(model, f)) {
      const Weave k = weave(model, f).scaled(face_factor(model, f) * model.rest->area[f]);
      const mesh::ShapeGradient woven = g * k.axes();
      for (int p = 0; p < 3; ++p) {
        for (int q = 0; q <= p; ++q) {
          own_values_[*slot++] +=
              k.warp * woven(p, 0) * woven(q, 0) + k.weft * woven(p, 1) * woven(q, 1);
        }
      }
      continue;
    }
    const double weight = face_factor(model, f) * stretch_weight(model, f);
    for (int p = 0; p < 3; ++p) {
      for (int q = 0; q <= p; ++q) own_values_[*slot++] += weight * g.row(p).dot(g.row(q));
    }
  }
  for (Index e = 0; e < model.stencils->size(); ++e) {
    bending::Element element = bending_element(model, e);
    if (element.flat) continue;
    element.weight *= element_factor(model, e);
    bending::add_constant(element, bending_slots(slots, e), own_values_.data());
  }
  for (const Springs& kind : springs) {
    for (Index a = 0; a < kind.size(); ++a) add_spring(kind, a);
  }
}

void ConstantForm::add_spring(const Springs& springs, Index a) {
  const auto points = springs.points(a);
  const auto b = springs.coefficients(a);
  const double k = springs.stiffness[a];
  double sum = 0.0;
  bool is_anchored = springs.target_row[a] >= 0;
  for (std::size_t p = 0; p < points.size(); ++p) {
    if (points[p] < vertex_count_) {
      sum += b[p];
    } else {
      is_anchored = true;
    }
  }
  for (std::size_t p = 0; p < points.size(); ++p) {
    if (points[p] >= vertex_count_) continue;
    for (std::size_t q = 0; q < points.size(); ++q) {
      if (points[q] > points[p] || points[q] >= vertex_count_) continue;
      if (points[p] == points[q] && q > p) continue;
      const double twice = points[p] == points[q] && p != q ? 2.0 : 1.0;
      own_values_[pattern_->slot(points[p], points[q])] += twice * k * b[p] * b[q];
    }
    // The sum of a row of L, which is zero for springs between points of cloths.
    if (!is_anchored) continue;
    anchor_vertex_.push_back(points[p]);
    anchor_stiffness_.push_back(k * b[p] * sum);
  }
}

double ConstantForm::energy_change(const double* u, const double* s) const {
  double change = 0.0;
  for (Index j = 0; j < vertex_count_; ++j) {
    for (Index k = pattern_->column_start()[j] + 1; k < pattern_->column_start()[j + 1]; ++k) {
      const Index i = pattern_->row()[k];
      const Vec3 ds = row(s, i) - row(s, j);
      change -= values_[k] * ds.dot(row(u, i) - row(u, j) + 0.5 * ds);
    }
  }
  for (std::size_t a = 0; a < anchor_vertex_.size(); ++a) {
    const Vec3 ds = row(s, anchor_vertex_[a]);
    change += anchor_stiffness_[a] * ds.dot(row(u, anchor_vertex_[a]) + 0.5 * ds);
  }
  return change;
}

void ConstantForm::add_product(const double* u, double* y) const {
  for (Index j = 0; j < vertex_count_; ++j) {
    const Vec3 u_j = row(u, j);
    Vec3 y_j = Vec3::Zero();
    for (Index k = pattern_->column_start()[j] + 1; k < pattern_->column_start()[j + 1]; ++k) {
      const Index i = pattern_->row()[k];
      const Vec3 pull = values_[k] * (row(u, i) - u_j);
      Eigen::Map<Vec3>(y + 3 * i) -= pull;
      y_j += pull;
    }
    Eigen::Map<Vec3>(y + 3 * j) += y_j;
  }
  for (std::size_t a = 0; a < anchor_vertex_.size(); ++a) {
    const Index i = anchor_vertex_[a];
    Eigen::Map<Vec3>(y + 3 * i) += anchor_stiffness_[a] * row(u, i);
  }
}

void add_constant_form_tangent(
    const Model& model, const double* u, const Bar& dot, const Changing& changing, double* y) {
  if (!changing.materials && !changing.rest) return;
  const auto add = is_woven(model) ? add_woven_constant_tangent : add_constant_tangent;
  for (Index f = 0; f < face_count(model); ++f) add(model, f, u, dot, changing, y);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_element_tangent(model, e, true, u, dot, changing, y);
  }
}

void add_constant_form_mixed(
    const Model& model, const double* u, const double* z, bool with_rest, Bar& bar) {
  const auto add = is_woven(model) ? add_woven_constant_mixed : add_constant_mixed;
  for (Index f = 0; f < face_count(model); ++f) add(model, f, u, z, with_rest, bar);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_element_mixed(model, e, true, u, z, with_rest, bar);
  }
}

void add_bending_form_mixed(
    const Model& model, const double* u, const double* z, bool with_rest, Bar& bar) {
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_element_mixed(model, e, false, u, z, with_rest, bar);
  }
}

void add_bending_form_tangent(
    const Model& model, const double* u, const Bar& dot, const Changing& changing, double* y) {
  if (!changing.materials && !changing.rest) return;
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_element_tangent(model, e, false, u, dot, changing, y);
  }
}

}  // namespace diffcloth::elastic
