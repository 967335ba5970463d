#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

/// Number of directions that the derivatives of a contact process side by side.
inline constexpr int kDirectionLanes = 8;

// Plain arrays and pointers: std::array is a template, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// Factors of a ContactHessian for products.
struct ContactProduct {
  std::int32_t point[4];
  int count;               ///< number of outer products
  const double* left[3];   ///< [12]
  const double* right[3];  ///< [12]
  const double* c;         ///< [4]
  double along;
  const double* rest;  ///< [12, 12], symmetric; null: none
};

/// Factors of a FrictionSet::Hessian for products.
struct FrictionProduct {
  const std::int32_t* point;
  const double* c;
  int frame;           ///< index of the first point of the frames
  int count;           ///< number of points
  const double* B[6];  ///< [3, 3], column-major, for each point of the frames
  const double* core;  ///< [3, 3], symmetric
  int part_count;      ///< number of parts of the gap: one or two, each with its frame
  const int* edge[2];
  const double* turn[2];  ///< [3]
};

/// Part of the gap that rotates with a frame, for FrictionTangent.
struct FrameTangent {
  const int* edge;
  bool turns;
  double share;       ///< fraction of the gap
  double a[3], b[3];  ///< coordinates of that fraction of t in the frame at x_L, of r' at x_start
  double extension_by_lag[2][3], extension_by_start[2][3];  ///< derivatives by both edges
  double e1_start[3], e2_start[3], e1_lag[3], e2_lag[3];
  double to_lag[3][3];              ///< E_L^-1
  double turn[3][3];                ///< E_L E(x_start)^-1
  double e1[3], e2[3], m[3];        ///< the frame at x
  double e2_force[3], force_e1[3];  ///< e2 x force, force x e1
};

/// Factors of the tangent of a contact's friction, in the notation of friction_tangent.cpp.
struct FrictionTangent {
  const std::int32_t* corner;  ///< [4]
  const double* corner_c;      ///< [4]
  const std::int32_t* point;
  const double* c;
  int count;                  ///< number of points
  int part_count;             ///< one or two
  bool slides;                ///< true if the closest points slide
  double beta[2][12];         ///< derivatives of the closest points' parameters by the lag corners
  double c_beta[4][2];        ///< derivative of the corners' coefficients
  double t_beta[3][2];        ///< derivative of the gap
  double r_beta[3][2];        ///< derivative of the vector between both points, at x
  double r_start_beta[3][2];  ///< same at x_start
  double n[3];
  double inv_d;
  double extension;  ///< l; below: its derivatives
  double extension_by_t[3], extension_by_n[3], extension_by_r[3];
  FrameTangent part[2];
  double s[3], w[3];
  double n_s;             ///< n . s
  double by_corners[12];  ///< derivative of the coefficient of w, through the normal force
  double by_w;            ///< derivative of the coefficient of w, by w . w_dot
  double stiffness;       ///< coefficient of w
  double force[3];
};

// NOLINTEND(modernize-avoid-c-arrays)

/// Derivatives of a contact along several directions, whose rows of all points lie side by side: [N, 3,
/// lanes].
///
/// The kernels use sums and products only, each rounded once, in one order: a direction has the same
/// bits alone, beside others, and at every level.
struct DirectionKernels {
  int lanes;

  /// y += H z.
  void (*contact_product)(const ContactProduct& of, const double* z, double* y);
  void (*friction_product)(const FrictionProduct& of, const double* z, double* y);

  /// y += change of the friction gradient with the lag configuration, the start, and the parameters'
  /// change of the coefficient of w: by_parameters [lanes].
  void (*friction_tangent)(const FrictionTangent& of,
                           const double* lag,
                           const double* start,
                           const double* by_parameters,
                           double* y);
};

/// Kernels of one level: for one direction, and for up to kDirectionLanes.
struct DirectionLevel {
  DirectionKernels one;
  DirectionKernels many;
};

/// @throws std::invalid_argument  if this processor or build does not support the level
const DirectionLevel& direction_kernels(linalg::KernelLevel level);

}  // namespace diffcloth::contact
