#include "elastic/woven_derivatives.h"

#include "elastic/elements.h"
#include "elastic/face_terms.h"
#include "elastic/frame.h"
#include "elastic/orthotropic_damping.h"
#include "elastic/orthotropic_stretch.h"

namespace diffcloth::elastic {
namespace {

double along(const Mat32& P, const Mat32& G) { return P.cwiseProduct(G).sum(); }

}  // namespace

void add_woven_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 G = face_gradient(model, f, z);
  for_each_stiffness(k, f, bar, [&](const Weave& one, double& k_bar) {
    k_bar += area * along(orthotropic::stress(one, F), G);
  });
  if (!with_rest) return;
  const Mat32 P = orthotropic::stress(k, F);
  bar.rest.area[f] += along(P, G);
  mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
  scatter_gradient_bar(model, f, orthotropic::stress_change(k.scaled(area), F, G), x, g_bar);
  scatter_gradient_bar(model, f, area * P, z, g_bar);
}

void add_woven_damping_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const double rate = model.damping[f] / model.h;
  const Mat32 F = face_gradient(model, f, x);
  const damping::Start start = damping_start(model, f);
  const Mat32 G = face_gradient(model, f, z);
  const Mat32 P = orthotropic_damping::stress(k, F, start);
  bar.damping[f] += area * along(P, G) / model.h;
  if (rate == 0.0) return;

  for_each_stiffness(k, f, bar, [&](const Weave& one, double& k_bar) {
    k_bar += rate * area * along(orthotropic_damping::stress(one, F, start), G);
  });
  const Weave damped = k.scaled(rate * area);
  add_damping_start(model, f, orthotropic_damping::start_bar(damped, F, start, G), with_rest, bar);
  if (!with_rest) return;
  bar.rest.area[f] += rate * along(P, G);
  mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
  scatter_gradient_bar(model, f, orthotropic_damping::stress_change(damped, F, start, G), x, g_bar);
  scatter_gradient_bar(model, f, rate * area * P, z, g_bar);
}

// y_p += dP g_p + P g_dot_p, with P the stress of stretch and damping, and its change dP.
void add_woven_tangent(const Model& model,
                       Index f,
                       const double* x,
                       const Bar& dot,
                       const Changing& changing,
                       double* y) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const double area_dot = changing.rest ? dot.rest.area[f] : 0.0;
  Weave force_dot = k.scaled(area_dot);  // change of k A
  if (changing.materials) {
    force_dot.warp += area * dot.stretch[f];
    force_dot.weft += area * dot.stretch_weft[f];
    force_dot.shear += area * dot.stretch_shear[f];
  }
  const Mat32 F = face_gradient(model, f, x);
  Mat32 F_dot = Mat32::Zero();
  if (changing.rest) F_dot = face_gradient(model, f, dot.rest.shape_gradient[f], x);
  Mat32 P = orthotropic::stress(k.scaled(area), F);
  Mat32 change =
      orthotropic::stress(force_dot, F) + orthotropic::stress_change(k.scaled(area), F, F_dot);
  if (model.x_n != nullptr) {
    const double rate = model.damping[f] / model.h;
    const double rate_dot = changing.materials ? dot.damping[f] / model.h : 0.0;
    const damping::Start start = damping_start(model, f);
    const Weave damped = k.scaled(rate * area);
    P += orthotropic_damping::stress(damped, F, start);
    change += orthotropic_damping::stress(k.scaled(rate_dot * area), F, start) +
              orthotropic_damping::stress(force_dot.scaled(rate), F, start) +
              orthotropic_damping::stress_change(damped, F, start, F_dot) +
              orthotropic_damping::stress_change(damped, F, start,
                                                 damping_start_change(model, f, dot, changing));
  }
  scatter(model, f, change, y);
  if (changing.rest) scatter(model, f, P, dot.rest.shape_gradient[f], y);
}

void add_woven_energy_bars(const Model& model,
                           Index f,
                           const double* x,
                           double seed,
                           bool with_rest,
                           Bar& bar,
                           double* x_bar) {
  const Weave k = weave(model, f);
  const double area = model.rest->area[f];
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 F_bar = orthotropic::stress(k.scaled(seed * area), F);
  scatter(model, f, F_bar, x_bar);
  for_each_stiffness(k, f, bar, [&](const Weave& one, double& k_bar) {
    k_bar += seed * area * orthotropic::energy(one, F);
  });
  if (!with_rest) return;
  bar.rest.area[f] += seed * orthotropic::energy(k, F);
  scatter_gradient_bar(model, f, F_bar, x, bar.rest.shape_gradient[f]);
}

}  // namespace diffcloth::elastic
