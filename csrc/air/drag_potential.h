#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "air/face_drag.h"
#include "common/types.h"
#include "potential/potential.h"

namespace diffcloth::air {

/// Faces that move through air during a step.
struct Flow {
  std::span<const std::array<Index, 3>> faces;
  std::vector<double> across;          ///< [F] a [kg/m^3]
  std::vector<double> along;           ///< [F] b [kg/m^3]
  const double* start = nullptr;       ///< [N, 3] x_n [m]
  Vec3 wind = Vec3::Zero();            ///< w [m/s]
  double h = 0.0;                      ///< time step [s]
  const double* velocities = nullptr;  ///< [N, 3] v_n, for the mean velocity, or null [m/s]
  /// Faces with a corner that is not a free vertex, if known: add_held_product() visits only these.
  const std::vector<Index>* held = nullptr;
};

/// Drag and lift of faces over one step,
///
///   P(x) = h sum_f D_f(u_f),    u_f = 1/3 sum_p (x_p - x_n,p) / h - w,
///
/// the sum over the corners p of a face. With given velocities v_n, drag acts on the mean velocity of
/// the step, and is of second order,
///
///   P(x) = 2 h sum_f D_f(u_f),    u_f = 1/3 sum_p ((x_p - x_n,p) / h + v_n,p) / 2 - w.
///
/// D (see FaceDrag) uses the normal and the area of the face at x_n, so that P is convex in x. Each
/// corner carries a third of the face's force: together they have the force and the moment of one at the
/// centroid.
class DragPotential final : public Potential {
 public:
  /// @param flow             its arrays must outlive the potential
  /// @param vertex_count     N
  /// @param of_coefficients  if true, also compute cotangents of the coefficients of faces without drag
  DragPotential(Flow flow, Index vertex_count, bool of_coefficients);

  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override;
  void add_held_product(const double* x, const double* z, double* y) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangent(const double* x, double* y) const override;
  void swap_cotangents(CotangentStore& store) override;

  // Cotangents, zero until accumulate(), and tangents, for add_tangent().
  std::vector<double> across_bar, along_bar;  ///< [F]
  std::vector<double> start_bar;              ///< [3 N]
  std::vector<double> velocity_bar;           ///< [3 N], of v_n; empty without velocities
  std::vector<double> wind_bar;               ///< [3]
  std::vector<double> across_dot, along_dot;  ///< [F]
  std::vector<double> start_dot;              ///< [3 N]
  std::vector<double> velocity_dot;           ///< [3 N], likewise
  Vec3 wind_dot = Vec3::Zero();

 private:
  /// Derivatives of a face that are common to several directions.
  struct Derivative {
    Vec3 u;
    Mat3 by_velocity;  ///< of grad D
    Mat3 by_frame;     ///< derivative of grad D by N
  };

  /// [F], computed on first use.
  const std::vector<FaceDrag>& drags() const;
  Vec3 velocity(Index f, const double* x) const;
  /// Derivatives of all faces with drag at x; the reference is valid until another point is used.
  const std::vector<Derivative>& derivatives(const double* x) const;
  void add_product(Index f, const Mat3& slope, const double* z, double* y) const;
  void add_frame_bar(Index f, const Vec3& N_bar);
  Vec3 frame_dot(Index f) const;

  Flow flow_;
  double span_;                   ///< h, or 2 h with given velocities [s]
  std::size_t size_;              ///< 3 N
  std::vector<Index> with_drag_;  ///< faces with nonzero drag
  bool of_coefficients_;
  mutable std::vector<FaceDrag> drags_;
  /// Positions of derivatives_, [3 N]; empty: none.
  mutable std::vector<double> derivatives_at_;
  mutable std::vector<Derivative> derivatives_;
};

}  // namespace diffcloth::air
