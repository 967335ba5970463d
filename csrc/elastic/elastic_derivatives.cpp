#include "elastic/bending.h"
#include "elastic/damping.h"
#include "elastic/elastic.h"
#include "elastic/elements.h"
#include "elastic/face_terms.h"
#include "elastic/form_numbers.h"
#include "elastic/frame.h"
#include "elastic/stretch.h"
#include "elastic/woven_derivatives.h"

// Cotangents and tangents of z . grad E, grad E and E of a model by all inputs except x.

namespace diffcloth::elastic {
namespace {

void add_face_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 G = face_gradient(model, f, z);
  const Mat32 unit = stretch::stress(1.0, F);
  const double work = unit.cwiseProduct(G).sum();
  bar.stretch[f] += area * work;
  if (with_rest) {
    bar.rest.area[f] += k_s * work;
    mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
    scatter_gradient_bar(model, f, stretch::stress_change(k_s * area, F, G), x, g_bar);
    scatter_gradient_bar(model, f, k_s * area * unit, z, g_bar);
  }
}

void add_face_damping_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double rate = model.damping[f] / model.h;
  const Mat32 F = face_gradient(model, f, x);
  const damping::Start start = damping_start(model, f);
  const Mat32 G = face_gradient(model, f, z);
  const Mat32 unit = damping::stress(1.0, F, start);
  const double work = unit.cwiseProduct(G).sum();
  bar.damping[f] += k_s * area * work / model.h;
  if (rate == 0.0) return;

  const double weight = rate * k_s * area;
  bar.stretch[f] += rate * area * work;
  add_damping_start(model, f, damping::start_bar(weight, F, start, G), with_rest, bar);
  if (with_rest) {
    bar.rest.area[f] += rate * k_s * work;
    mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
    scatter_gradient_bar(model, f, damping::stress_change(weight, F, start, G), x, g_bar);
    scatter_gradient_bar(model, f, weight * unit, z, g_bar);
  }
}

/// Destinations of the cotangents of the geometry of a bending element.
bending::GeometryBars geometry_bars(const Model& model, Index e, bool with_rest, Bar& bar) {
  bending::GeometryBars geometry;
  geometry.x_n = bar.x_n.data();
  geometry.ahead = bar.ahead.data();
  if (with_rest) {
    geometry.c = bar.rest.curvature_operator.data() + 3 * model.stencils->start[e];
    geometry.g = &bar.rest.shape_gradient[model.stencils->faces[e][0]];
    geometry.b = &bar.rest.curvature[e];
  }
  return geometry;
}

void add_bending_mixed(
    const Model& model, Index e, const double* x, const double* z, bool with_rest, Bar& bar) {
  bending::Element element = differentiable_element(model, e);
  Mat3 curvature_n;
  if (model.x_n != nullptr) {
    curvature_n = bending::start_curvature(element, start_of(model));
    element.b_n = &curvature_n;
  }
  const FormNumbers numbers(model, e);
  const bending::ScalarBars scalar =
      bending::mixed(element, numbers.derivatives(), x, start_of(model), z,
                     geometry_bars(model, e, with_rest, bar));
  add_weight_bars(model, e, scalar, with_rest, bar);
  if (model.x_n != nullptr) add_to_faces(model, e, scalar.damping / model.h, bar.damping);
}

/// y_p += dP g_p + P g_dot_p, with P = k_s A (F - R) and its change dP.
void add_face_tangent(const Model& model,
                      Index f,
                      const double* x,
                      const Bar& dot,
                      const Changing& changing,
                      double* y) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double k_dot = changing.materials ? dot.stretch[f] : 0.0;
  const double area_dot = changing.rest ? dot.rest.area[f] : 0.0;
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 unit = stretch::stress(1.0, F);
  Mat32 change = (k_dot * area + k_s * area_dot) * unit;
  Mat32 P = k_s * area * unit;
  Mat32 F_dot = Mat32::Zero();
  if (changing.rest) {
    F_dot = face_gradient(model, f, dot.rest.shape_gradient[f], x);
    change += stretch::stress_change(k_s * area, F, F_dot);
  }
  if (model.x_n != nullptr) {
    const double rate = model.damping[f] / model.h;
    const double rate_dot = changing.materials ? dot.damping[f] / model.h : 0.0;
    if (rate != 0.0 || rate_dot != 0.0) {
      const damping::Start start = damping_start(model, f);
      const Mat32 unit_n = damping::stress(1.0, F, start);
      const double weight = rate * k_s * area;
      change += (rate_dot * k_s * area + rate * (k_dot * area + k_s * area_dot)) * unit_n;
      P += weight * unit_n;
      if (changing.rest) change += damping::stress_change(weight, F, start, F_dot);
      change +=
          damping::stress_change(weight, F, start, damping_start_change(model, f, dot, changing));
    }
  }
  scatter(model, f, change, y);
  if (changing.rest) scatter(model, f, P, dot.rest.shape_gradient[f], y);
}

void add_bending_tangent(const Model& model,
                         Index e,
                         const double* x,
                         const Bar& dot,
                         const Changing& changing,
                         double* y) {
  bending::Element element = differentiable_element(model, e);
  bending::Tangents tangents;
  if (changing.materials) {
    if (!is_plate(model, e)) {
      tangents.weight = element_mean(model, e, dot.bending) * model.rest->bending_area[e];
    }
    tangents.form = FormNumbers(model, e).change(dot);
    if (model.x_n != nullptr) tangents.damping = element_mean(model, e, dot.damping) / model.h;
  }
  if (changing.rest) {
    tangents.weight += element_stiffness(model, e) * dot.rest.bending_area[e];
    tangents.c = dot.rest.curvature_operator.data() + 3 * model.stencils->start[e];
    tangents.g = &dot.rest.shape_gradient[model.stencils->faces[e][0]];
    tangents.b = &dot.rest.curvature[e];
  }
  if (changing.start) {
    tangents.x_n = dot.x_n.data();
    tangents.ahead = dot.ahead.data();
  }
  Mat3 curvature_n;
  if (model.x_n != nullptr) {
    curvature_n = bending::start_curvature(element, start_of(model));
    element.b_n = &curvature_n;
  }
  bending::add_tangent(element, x, start_of(model), tangents, y);
}

// E = k_s A W(F), with dW/dF the stress of unit weight.
void add_face_energy_bars(const Model& model,
                          Index f,
                          const double* x,
                          double seed,
                          bool with_rest,
                          Bar& bar,
                          double* x_bar) {
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 F_bar = stretch::stress(seed * stretch_weight(model, f), F);
  const double unit = seed * stretch::energy(1.0, F);
  scatter(model, f, F_bar, x_bar);
  bar.stretch[f] += model.rest->area[f] * unit;
  if (with_rest) {
    bar.rest.area[f] += model.stretch[f] * unit;
    scatter_gradient_bar(model, f, F_bar, x, bar.rest.shape_gradient[f]);
  }
}

void add_bending_energy_bars(const Model& model,
                             Index e,
                             const double* x,
                             double seed,
                             bool with_rest,
                             Bar& bar,
                             double* x_bar) {
  const FormNumbers numbers(model, e);
  const bending::ScalarBars scalar =
      bending::energy_bars(differentiable_element(model, e), numbers.derivatives(), x, seed,
                           geometry_bars(model, e, with_rest, bar), x_bar);
  add_weight_bars(model, e, scalar, with_rest, bar);
}

}  // namespace

void add_mixed(const Model& model, const double* x, const double* z, bool with_rest, Bar& bar) {
  for (Index f = 0; f < face_count(model); ++f) {
    if (is_woven(model)) {
      add_woven_mixed(model, f, x, z, with_rest, bar);
      if (model.x_n != nullptr) add_woven_damping_mixed(model, f, x, z, with_rest, bar);
    } else {
      add_face_mixed(model, f, x, z, with_rest, bar);
      if (model.x_n != nullptr) add_face_damping_mixed(model, f, x, z, with_rest, bar);
    }
  }
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_bending_mixed(model, e, x, z, with_rest, bar);
  }
}

void add_tangent(
    const Model& model, const double* x, const Bar& dot, const Changing& changing, double* y) {
  const bool damped = model.prepared->has_damping && changing.start;
  if (!changing.materials && !changing.rest && !damped) return;
  const auto add = is_woven(model) ? add_woven_tangent : add_face_tangent;
  for (Index f = 0; f < face_count(model); ++f) add(model, f, x, dot, changing, y);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_bending_tangent(model, e, x, dot, changing, y);
  }
}

void add_energy_bars(const Model& model,
                     const double* x,
                     const Energies& seed,
                     bool with_rest,
                     Bar& bar,
                     double* x_bar) {
  for (Index f = 0; seed.stretch != 0.0 && f < face_count(model); ++f) {
    const auto add = is_woven(model) ? add_woven_energy_bars : add_face_energy_bars;
    add(model, f, x, seed.stretch, with_rest, bar, x_bar);
  }
  for (Index e = 0; seed.bending != 0.0 && e < model.stencils->size(); ++e) {
    add_bending_energy_bars(model, e, x, seed.bending, with_rest, bar, x_bar);
  }
}

}  // namespace diffcloth::elastic
