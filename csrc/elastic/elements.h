#pragma once

#include <array>
#include <span>
#include <vector>

#include "elastic/bending.h"
#include "elastic/elastic.h"
#include "elastic/frame.h"
#include "elastic/weave.h"

namespace diffcloth::elastic {

// The elements of a Model, from its parameters and its rest shape.

inline Index face_count(const Model& model) {
  return static_cast<Index>(model.topology->faces.size());
}

inline Mat32 face_gradient(const Model& model, Index f, const double* x) {
  const std::array<Index, 3>& face = model.topology->faces[f];
  return deformation_gradient(model.rest->shape_gradient[f], row(x, face[0]), row(x, face[1]),
                              row(x, face[2]));
}

/// The gradient with other shape gradients.
inline Mat32 face_gradient(const Model& model,
                           Index f,
                           const mesh::ShapeGradient& g,
                           const double* x) {
  const std::array<Index, 3>& face = model.topology->faces[f];
  return deformation_gradient(g, row(x, face[0]), row(x, face[1]), row(x, face[2]));
}

/// y_p += P g_p over the corners of a face.
inline void scatter(
    const Model& model, Index f, const Mat32& P, const mesh::ShapeGradient& g, double* y) {
  for (int p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(y + 3 * model.topology->faces[f][p]) += P * g.row(p).transpose();
  }
}
inline void scatter(const Model& model, Index f, const Mat32& P, double* y) {
  scatter(model, f, P, model.rest->shape_gradient[f], y);
}

inline double stretch_weight(const Model& model, Index f) {
  return model.stretch[f] * model.rest->area[f];
}

/// True if stretch has derivatives by three stiffnesses. Their values may be equal: see
/// is_orthotropic().
inline bool is_woven(const Model& model) { return !model.stretch_weft.empty(); }

inline Weave weave(const Model& model, Index f) {
  return {.warp = model.stretch[f],
          .weft = model.stretch_weft[f],
          .shear = model.stretch_shear[f],
          .axis = (*model.axes)[f]};
}

/// True if the stretch of a face depends on its direction. Other faces have one stiffness, k_s.
inline bool is_orthotropic(const Model& model, Index f) {
  return is_woven(model) &&
         (model.stretch_weft[f] != model.stretch[f] || model.stretch_shear[f] != model.stretch[f]);
}

/// The mean over the faces of a bending element.
inline double element_mean(const Model& model, Index e, const std::vector<double>& face_values) {
  const auto [f0, f1] = model.stencils->faces[e];
  return f1 < 0 ? face_values[f0] : 0.5 * (face_values[f0] + face_values[f1]);
}

/// The transpose of element_mean().
inline void add_to_faces(const Model& model, Index e, double bar, std::vector<double>& face_bars) {
  const auto [f0, f1] = model.stencils->faces[e];
  if (f1 < 0) {
    face_bars[f0] += bar;
  } else {
    face_bars[f0] += 0.5 * bar;
    face_bars[f1] += 0.5 * bar;
  }
}

/// True if bending has derivatives by three stiffnesses: for patches alone, as a hinge bends in one
/// direction.
inline bool is_plate(const Model& model, Index e) {
  return !model.bending_weft.empty() && model.stencils->model[e] == mesh::BendingModel::kPatch;
}

/// Plate of a patch, with the parameters of its base face.
inline Plate plate(const Model& model, Index e) {
  const Index f = model.stencils->faces[e][0];
  return {.warp = model.bending[f],
          .weft = model.bending_weft[f],
          .twill = model.bending_twill[f],
          .poisson = model.poisson[f],
          .axis = (*model.axes)[f]};
}

inline bending::Element bending_element(const Model& model, Index e) {
  const mesh::BendingStencils& stencils = *model.stencils;
  const Prepared& prepared = *model.prepared;
  return {.vertices = stencils.element(e),
          .c = model.rest->curvature_operator.data() + 3 * stencils.start[e],
          .g = &model.rest->shape_gradient[stencils.faces[e][0]],
          .weight = prepared.bending[e],
          .form = prepared.form[e],
          .damping = prepared.damping[e],
          .b = &model.rest->curvature[e],
          .b_n = &prepared.curvature_n[e],
          .flat = prepared.flat[e] != 0};
}

/// Start of the damping of bending.
inline bending::Start start_of(const Model& model) {
  return {.x_n = model.x_n, .ahead = model.ahead};
}

inline std::span<const Index> bending_slots(const Slots& slots, Index e) {
  return {slots.bending.data() + slots.bending_start[e],
          static_cast<std::size_t>(slots.bending_start[e + 1] - slots.bending_start[e])};
}

/// g_p += F_bar^T x_p, with x relative to the first corner (the gradients sum to zero).
inline void scatter_gradient_bar(
    const Model& model, Index f, const Mat32& F_bar, const double* x, mesh::ShapeGradient& g_bar) {
  const std::array<Index, 3>& face = model.topology->faces[f];
  for (int p = 1; p < 3; ++p) {
    g_bar.row(p) += (row(x, face[p]) - row(x, face[0])).transpose() * F_bar;
  }
}

}  // namespace diffcloth::elastic
