#pragma once

#include <array>
#include <span>

#include "common/types.h"
#include "elastic/bending_form.h"
#include "elastic/frame.h"

namespace diffcloth::elastic::bending {

/// One bending element. With the second derivatives Y_ab = sum_i c_ab,i x_i and the frame R(x) of the
/// base triangle, its curvature in this frame is R^T Y, and
///
///   E = weight / 2 [ <s Q, s> + damping <s_n Q, s_n> ],   s = R^T Y - b,  s_n = R^T Y - b_n,
///
/// Q a form of bending_form.h, b the rest curvature and b_n the curvature at the start of the step: both
/// terms are exactly invariant under rigid motion. If b = 0 and damping = 0, the energy is quadratic in
/// x. In a hinge only the row uu is not zero, and nu has no effect.
struct Element {
  std::span<const Index> vertices;  ///< the base triangle first
  const double* c;                  ///< 3 a vertex: c_uu, c_uv, c_vv [1/m^2]
  const mesh::ShapeGradient* g;     ///< shape gradient of the base triangle
  double weight;                    ///< D A [N m^3], or A [m^2] if the form contains D
  Mat3 form;                        ///< Q
  double damping;                   ///< k_d / h [-]
  const Mat3* b;                    ///< rest curvature [1/m]
  const Mat3* b_n;                  ///< curvature at the start of the step [1/m]
  bool flat;                        ///< b = 0 and damping = 0

  Eigen::Map<const Vec3> weights(Index i) const { return Eigen::Map<const Vec3>(c + 3 * i); }
  Index size() const { return static_cast<Index>(vertices.size()); }
};

/// Curvature R^T Y in the frame of the base triangle.
Mat3 body_curvature(const Element& element, const double* x);

/// Energy without damping.
double energy(const Element& element, const double* x);

// The energy of elements that are not flat, its gradient and its Hessian are in bending_lanes.h.

/// Energy of a flat element at x1 minus its energy at x0, from differences of positions.
double flat_energy_change(const Element& element, const double* x0, const double* x1);

/// g += the gradient of a flat element.
void add_flat_gradient(const Element& element, const double* x, double* g);

/// constant[slot] += weight c_i^T Q c_j: times I, this is the Hessian of a flat element, and the part of
/// the Hessian of other elements, without damping, that is a multiple of I.
void add_constant(const Element& element, std::span<const Index> slots, double* constant);

/// y += H z.
void add_hessian_product(const Element& element, const double* x, const double* z, double* y);

/// Derivatives of the form of an element by its parameters, at most four.
using FormDerivatives = std::span<const Mat3>;

/// Cotangents of the parameters of an element for phi = z . grad E.
struct ScalarBars {
  double weight = 0.0;
  double damping = 0.0;
  std::array<double, 4> form{};  ///< cotangents of the parameters of the form
};

/// Cotangents for phi = weight <Y(u) Q, Y(z)>, the form of add_constant(); c_bar may be null.
ScalarBars constant_mixed(const Element& element,
                          FormDerivatives derivatives,
                          const double* u,
                          const double* z,
                          double* c_bar);

/// Start of damping: the start of a step and, for steps of second order, a prediction of its end.
struct Start {
  const double* x_n;    ///< [N, 3], or null without a start
  const double* ahead;  ///< [N, 3], or null without a prediction
};

/// b_n: the body-frame curvature at x_n, or with a prediction  b(x_n) - kAhead (b(ahead) - b(x_n));  see
/// damping.h.
Mat3 start_curvature(const Element& element, const Start& start);

/// Destinations of the cotangents of the geometry of an element. Null pointers are skipped.
struct GeometryBars {
  double* c = nullptr;               ///< 3 a vertex
  mesh::ShapeGradient* g = nullptr;  ///< gradient of the base triangle
  Mat3* b = nullptr;
  double* x_n = nullptr;    ///< [N, 3]
  double* ahead = nullptr;  ///< [N, 3], read with a prediction alone
};

/// Cotangents for phi = seed E, without damping; bars.x_n is unchanged.
///
/// @param x_bar  += d phi / dx, [N, 3]
ScalarBars energy_bars(Element element,
                       FormDerivatives derivatives,
                       const double* x,
                       double seed,
                       const GeometryBars& bars,
                       double* x_bar);

/// @param start  without a start, element.b_n is not read
ScalarBars mixed(const Element& element,
                 FormDerivatives derivatives,
                 const double* x,
                 const Start& start,
                 const double* z,
                 const GeometryBars& bars);

/// Tangents of the parameters and the geometry of an element; null pointers are zero.
struct Tangents {
  double weight = 0.0;
  double damping = 0.0;
  Mat3 form = Mat3::Zero();
  const double* c = nullptr;               ///< 3 a vertex; if given, g and b are as well
  const mesh::ShapeGradient* g = nullptr;  ///< gradient of the base triangle
  const Mat3* b = nullptr;
  const double* x_n = nullptr;    ///< [N, 3]
  const double* ahead = nullptr;  ///< [N, 3]
};

/// y += the change of weight Y(u) Q with these tangents, over the element: constant_mixed(), transposed;
/// tangents of the geometry are limited to c.
void add_constant_tangent(const Element& element, const double* u, const Tangents& dot, double* y);

/// y += the change of grad E with these tangents: mixed(), transposed.
///
/// @param start  as for mixed()
void add_tangent(
    const Element& element, const double* x, const Start& start, const Tangents& dot, double* y);

}  // namespace diffcloth::elastic::bending
