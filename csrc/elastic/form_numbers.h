#pragma once

#include <array>
#include <cstddef>

#include "elastic/bending.h"
#include "elastic/elements.h"

namespace diffcloth::elastic {

/// D of an element with a form that does not contain D; else 1.
inline double element_stiffness(const Model& model, Index e) {
  return is_plate(model, e) ? 1.0 : element_mean(model, e, model.bending);
}

/// A bending element with a form of all parameters that have derivatives, even if their values are equal
/// and its energy uses a single one: D_w, D_f, D_t and nu of a plate, else nu.
inline bending::Element differentiable_element(const Model& model, Index e) {
  bending::Element element = bending_element(model, e);
  if (is_plate(model, e)) {
    element.weight = model.rest->bending_area[e];
    element.form = plate_form(plate(model, e));
  }
  return element;
}

/// The parameters in the form of differentiable_element().
class FormNumbers {
 public:
  FormNumbers(const Model& model, Index e)
      : model_(model), element_(e), count_(is_plate(model, e) ? 4 : 1) {
    if (count_ == 4) {
      forms_ = plate_form_derivatives(plate(model, e));
    } else {
      forms_[0] = isotropic_form_derivative();
    }
  }

  bending::FormDerivatives derivatives() const { return {forms_.data(), count_}; }

  /// Change of the form with tangents of the faces' parameters.
  Mat3 change(const Bar& dot) const {
    if (count_ == 1) return element_mean(model_, element_, dot.poisson) * forms_[0];
    const Index f = model_.stencils->faces[element_][0];
    return dot.bending[f] * forms_[0] + dot.bending_weft[f] * forms_[1] +
           dot.bending_twill[f] * forms_[2] + dot.poisson[f] * forms_[3];
  }

 private:
  const Model& model_;
  Index element_;
  std::size_t count_;
  std::array<Mat3, 4> forms_;
};

/// Pull the cotangents of the weight and the form of differentiable_element() back to the faces.
inline void add_weight_bars(
    const Model& model, Index e, const bending::ScalarBars& scalar, bool with_rest, Bar& bar) {
  if (is_plate(model, e)) {
    const Index f = model.stencils->faces[e][0];
    bar.bending[f] += scalar.form[0];
    bar.bending_weft[f] += scalar.form[1];
    bar.bending_twill[f] += scalar.form[2];
    bar.poisson[f] += scalar.form[3];
  } else {
    add_to_faces(model, e, scalar.weight * model.rest->bending_area[e], bar.bending);
    add_to_faces(model, e, scalar.form[0], bar.poisson);
  }
  if (with_rest) bar.rest.bending_area[e] += scalar.weight * element_stiffness(model, e);
}

}  // namespace diffcloth::elastic
