#include "elastic/strain_rate.h"

#include <numeric>

#include "elastic/elements.h"
#include "elastic/face_batches.h"
#include "elastic/face_terms.h"
#include "elastic/stretch_lanes.h"
#include "elastic/symmetric2.h"
#include "elastic/woven_derivatives.h"

namespace diffcloth::elastic {
namespace {

/// The strain rate sym(F_u^T F(d)) of a face.
Mat2 strain_rate(const Mat32& F_u, const Mat32& D) { return symmetric_part(F_u.transpose() * D); }

/// z^T S d of one face, its derivatives by the gradients of u and d, and the same for a change.
struct FaceForm {
  FaceForm(const Model& model, Index f, const double* u, const double* d)
      : weave(stretch_weave(model, f)),
        F_u(face_gradient(model, f, u)),
        D(face_gradient(model, f, d)),
        of_d(weave.times_in_rest_frame(strain_rate(F_u, D))) {}

  /// Derivative by F(z).
  Mat32 stress() const { return F_u * of_d; }

  Weave weave;  ///< times the area
  Mat32 F_u;
  Mat32 D;
  Mat2 of_d;
};

void add_face_mixed(const Model& model,
                    Index f,
                    const double* u,
                    const double* d,
                    const double* z,
                    Wanted wanted,
                    Bar& bar,
                    double* u_bar) {
  const FaceForm form(model, f, u, d);
  const Mat32 Z = face_gradient(model, f, z);
  const Mat2 rate_z = strain_rate(form.F_u, Z);
  const Mat2 of_z = form.weave.times_in_rest_frame(rate_z);
  const Mat32 F_u_bar = Z * form.of_d + form.D * of_z;
  scatter(model, f, F_u_bar, u_bar);
  if (wanted == Wanted::kNone) return;
  const double area = model.rest->area[f];
  const Mat2 rate_d = strain_rate(form.F_u, form.D);
  if (is_woven(model)) {
    for_each_stiffness(weave(model, f), f, bar, [&](const Weave& one, double& k_bar) {
      k_bar += area * one.times_in_rest_frame(rate_d).cwiseProduct(rate_z).sum();
    });
  } else {
    bar.stretch[f] += area * rate_d.cwiseProduct(rate_z).sum();
  }
  if (wanted != Wanted::kMaterialsAndRest) return;
  bar.rest.area[f] += form.of_d.cwiseProduct(rate_z).sum() / area;
  mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
  scatter_gradient_bar(model, f, F_u_bar, u, g_bar);
  scatter_gradient_bar(model, f, form.stress(), z, g_bar);
  scatter_gradient_bar(model, f, form.F_u * of_z, d, g_bar);
}

/// y += the change of S d with tangents of the model and of u.
void add_face_tangent(const Model& model,
                      Index f,
                      const double* u,
                      const double* d,
                      const Bar& dot,
                      const Changing& changing,
                      const double* u_dot,
                      double* y) {
  const FaceForm form(model, f, u, d);
  Mat32 F_u_dot = face_gradient(model, f, u_dot);
  Mat32 D_dot = Mat32::Zero();
  const double area = model.rest->area[f];
  Weave weave_dot = form.weave.scaled(0.0);
  if (changing.materials) {
    const bool woven = is_woven(model);
    weave_dot.warp += area * dot.stretch[f];
    weave_dot.weft += area * (woven ? dot.stretch_weft[f] : dot.stretch[f]);
    weave_dot.shear += area * (woven ? dot.stretch_shear[f] : dot.stretch[f]);
  }
  if (changing.rest) {
    const Weave per_area = form.weave.scaled(dot.rest.area[f] / area);
    weave_dot.warp += per_area.warp;
    weave_dot.weft += per_area.weft;
    weave_dot.shear += per_area.shear;
    const mesh::ShapeGradient& g_dot = dot.rest.shape_gradient[f];
    F_u_dot += face_gradient(model, f, g_dot, u);
    D_dot = face_gradient(model, f, g_dot, d);
    scatter(model, f, form.stress(), g_dot, y);
  }
  const Mat2 rate_dot = strain_rate(F_u_dot, form.D) + strain_rate(form.F_u, D_dot);
  const Mat2 change = weave_dot.times_in_rest_frame(strain_rate(form.F_u, form.D)) +
                      form.weave.times_in_rest_frame(rate_dot);
  scatter(model, f, F_u_dot * form.of_d + form.F_u * change, y);
}

/// S of stretch: the Hessian of damping over a time step at its start.
void add_stretch_blocks(const Model& model,
                        const Slots& slots,
                        const double* u,
                        std::vector<double>& blocks) {
  Model damped = model;
  damped.h = 1.0;
  damped.damping.assign(model.damping.size(), 1.0);
  damped.x_n = u;
  damped.ahead = nullptr;
  std::vector<Index> faces(model.topology->faces.size());
  std::iota(faces.begin(), faces.end(), 0);
  std::vector<DampingBatch> batches = damping_batches(damped, slots, faces);
  put_start_gradients(damped, faces, batches);
  std::vector<Index> place(blocks.size() / 9);
  std::iota(place.begin(), place.end(), 0);
  stretch_kernels().add_damping_hessian(batches.data(), batches.size(), u, false, place.data(),
                                        blocks.data());
}

}  // namespace

StrainRate::StrainRate(ElasticPotential& elastic,
                       const linalg::BlockPattern& pattern,
                       const double* middle,
                       const double* start)
    : middle_bar(3 * static_cast<std::size_t>(elastic.model().topology->vertex_count), 0.0),
      start_bar(middle_bar),
      elastic_(elastic),
      model_(elastic.model()),
      middle_(middle),
      start_(start),
      pattern_(pattern) {}

std::vector<double> StrainRate::displacement(const double* x) const {
  std::vector<double> d(3 * static_cast<std::size_t>(pattern_.size()), 0.0);
  for (std::size_t a = 0; a < size(); ++a) d[a] = x[a] - start_[a];
  return d;
}

const std::vector<double>& StrainRate::blocks() const {
  if (!blocks_.empty()) return blocks_;
  blocks_.assign(9 * static_cast<std::size_t>(pattern_.block_count()), 0.0);
  add_stretch_blocks(model_, elastic_.slots(), middle_, blocks_);
  const ConstantForm bending = ConstantForm::of_bending(model_, elastic_.slots(), pattern_);
  for (std::size_t slot = 0; slot < bending.values().size(); ++slot) {
    for (std::size_t k = 0; k < 9; k += 4) blocks_[9 * slot + k] += bending.values()[slot];
  }
  return blocks_;
}

double StrainRate::product(const std::vector<double>& z, const std::vector<double>& d) const {
  std::vector<double> y(d.size(), 0.0);
  add_hessian_product(nullptr, d.data(), y.data());
  return std::inner_product(y.begin(), y.end(), z.begin(), 0.0);
}

double StrainRate::energy(const double* x) const {
  const std::vector<double> d = displacement(x);
  return 0.5 * product(d, d);
}

double StrainRate::energy_change(const double* x, const double* to) const {
  std::vector<double> sum = displacement(x);
  std::vector<double> step(sum.size(), 0.0);
  for (std::size_t a = 0; a < size(); ++a) {
    step[a] = to[a] - x[a];
    sum[a] += 0.5 * step[a];
  }
  return product(sum, step);
}

void StrainRate::add_gradient(const double* x, double* g) const {
  add_hessian_product(x, displacement(x).data(), g);
}

void StrainRate::add_hessian(const double* /*x*/,
                             Curvature /*curvature*/,
                             linalg::BlockMatrix& A) const {
  const std::vector<double>& own = blocks();
  const std::vector<Index>& place = A.slot_of_base();
  for (std::size_t slot = 0; slot < place.size(); ++slot) {
    double* const block = A.blocks() + 9 * static_cast<std::ptrdiff_t>(place[slot]);
    for (std::size_t k = 0; k < 9; ++k) block[k] += own[9 * slot + k];
  }
}

void StrainRate::add_hessian_product(const double* /*x*/, const double* z, double* y) const {
  linalg::add_products(pattern_, blocks().data(), {&z, 1}, {&y, 1});
}

void StrainRate::accumulate(const double* x, const double* z) {
  const std::vector<double> d = displacement(x);
  std::vector<double> minus(z, z + size());
  for (double& value : minus) value = -value;
  const Wanted wanted = elastic_.wanted();
  Bar& bar = elastic_.bar();
  for (Index f = 0; f < face_count(model_); ++f) {
    add_face_mixed(model_, f, middle_, d.data(), minus.data(), wanted, bar, middle_bar.data());
  }
  if (wanted != Wanted::kNone) {
    add_bending_form_mixed(model_, d.data(), minus.data(), wanted == Wanted::kMaterialsAndRest,
                           bar);
  }
  std::vector<double> product(d.size(), 0.0);
  add_hessian_product(x, z, product.data());
  for (std::size_t a = 0; a < size(); ++a) start_bar[a] += product[a];
}

void StrainRate::add_tangent(const double* x, double* y) const {
  const std::vector<double> d = displacement(x);
  for (Index f = 0; f < face_count(model_); ++f) {
    add_face_tangent(model_, f, middle_, d.data(), elastic_.tangent(), elastic_.changing(),
                     middle_dot.data(), y);
  }
  add_bending_form_tangent(model_, d.data(), elastic_.tangent(), elastic_.changing(), y);
  std::vector<double> minus(d.size(), 0.0);
  for (std::size_t a = 0; a < size(); ++a) minus[a] = -start_dot[a];
  add_hessian_product(x, minus.data(), y);
}

}  // namespace diffcloth::elastic
