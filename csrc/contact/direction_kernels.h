#pragma once

#include <cstdint>

#include "linalg/kernel_level.h"

namespace diffcloth::contact {

/// Directions that go through the derivatives of a contact side by side.
inline constexpr int kDirectionLanes = 8;

// Plain arrays and pointers: those of the standard library are templates, see linalg/dense_kernels_impl.h.
// NOLINTBEGIN(modernize-avoid-c-arrays)

/// A ContactHessian, which is to be multiplied.
struct ContactProduct {
  std::int32_t point[4];
  int count;               ///< of the products
  const double* left[3];   ///< [12]
  const double* right[3];  ///< [12]
  const double* c;         ///< [4]
  double along;
  const double* rest;  ///< [12, 12], symmetric; null where there is none
};

/// A FrictionSet::Hessian, which is to be multiplied.
struct FrictionProduct {
  const std::int32_t* point;
  const double* c;
  int frame;           ///< where the points of the frames begin
  int count;           ///< of the points
  const double* B[6];  ///< [3, 3], column by column, of the frames' points
  const double* core;  ///< [3, 3], symmetric
  int part_count;      ///< of the gap: one or two, each with its frame
  const int* edge[2];
  const double* turn[2];  ///< [3]
};

/// A part of the gap that turns with a frame, of a FrictionTangent.
struct FrameTangent {
  const int* edge;
  bool turns;
  double share;       ///< of the gap
  double a[3], b[3];  ///< that share of t in the frame at x_L, and of r' in that at x_start
  double extension_by_lag[2][3], extension_by_start[2][3];  ///< by both edges
  double e1_start[3], e2_start[3], e1_lag[3], e2_lag[3];
  double to_lag[3][3];              ///< E_L^-1
  double turn[3][3];                ///< E_L E(x_start)^-1
  double e1[3], e2[3], m[3];        ///< the frame at x
  double e2_force[3], force_e1[3];  ///< e2 x force, force x e1
};

/// What the tangents of a contact's friction are made of, in the terms of friction_tangent.cpp.
struct FrictionTangent {
  const std::int32_t* corner;  ///< [4]
  const double* corner_c;      ///< [4]
  const std::int32_t* point;
  const double* c;
  int count;                  ///< of the points
  int part_count;             ///< one or two
  bool slides;                ///< whether the nearest points do
  double beta[2][12];         ///< of the nearest points by the corners of the lag configuration
  double c_beta[4][2];        ///< of the corners' coefficients
  double t_beta[3][2];        ///< of the gap
  double r_beta[3][2];        ///< of the vector between both points, at x
  double r_start_beta[3][2];  ///< the same at x_start
  double n[3];
  double inv_d;
  double extension;  ///< l, and by what it changes
  double extension_by_t[3], extension_by_n[3], extension_by_r[3];
  FrameTangent part[2];
  double s[3], w[3];
  double n_s;             ///< n . s
  double by_corners[12];  ///< of the share of w, by the normal force
  double by_w;            ///< of the share of w, by w . w_dot
  double stiffness;       ///< the share of w
  double force[3];
};

// NOLINTEND(modernize-avoid-c-arrays)

/// Derivatives of a contact along directions, whose rows of all points lie side by side: [N, 3, lanes].
///
/// Only sums and products, each rounded once, in one order: a direction has the same bits alone, beside others,
/// and at every level.
struct DirectionKernels {
  int lanes;

  /// y += H z.
  void (*contact_product)(const ContactProduct& of, const double* z, double* y);
  void (*friction_product)(const FrictionProduct& of, const double* z, double* y);

  /// y += the change of friction's gradient with the lag configuration, the start, and what else changes the
  /// share of w: by_parameters [lanes].
  void (*friction_tangent)(const FrictionTangent& of,
                           const double* lag,
                           const double* start,
                           const double* by_parameters,
                           double* y);
};

/// Those of one level: for one direction, and for up to kDirectionLanes.
struct DirectionLevel {
  DirectionKernels one;
  DirectionKernels many;
};

/// @throws std::invalid_argument  where this processor or build has none of that level
const DirectionLevel& direction_kernels(linalg::KernelLevel level);

}  // namespace diffcloth::contact
