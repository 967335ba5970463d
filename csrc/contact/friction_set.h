#pragma once

#include <array>
#include <span>
#include <vector>

#include "contact/contact_set.h"

namespace diffcloth::contact {

/// Lagged friction: sum over contacts of mu lambda f0(|w|; e)  [J],
///
///   w = (I - n n^T) s,   s = r(x) - Q r(x_start),   r(x) = sum_i c_i x_i,   e = eps_v h,
///
/// with c, n and the normal force lambda = -kappa w m b'(D) 2 d [N] of the lag configuration held
/// fixed. r is the vector from one contact point to the other, and Q turns it as the surface turns
/// that its `frame` belongs to: what turns as one does not slide, and friction has no couple about the
/// gap. Obstacle vertices take part, so that a moving body drags the cloth.
///
/// Q comes from three vertices of that surface. With e1 and e2 from the first of them to the others and
/// m = e1 x e2,
///
///   Q r(x_start) = a1 e1(x) + a2 e2(x) + a3 m(x),   where a makes it r(x_start) at x_start.
class FrictionSet {
 public:
  FrictionSet() = default;

  /// @param contacts  the contacts of the lag configuration
  /// @param x_start   positions at the start of the step; they outlive this object
  FrictionSet(const ContactModel& model,
              const std::vector<Contact>& contacts,
              const double* x_start);

  const ContactModel& model() const { return *model_; }
  bool empty() const { return entries_.empty(); }

  struct Entry {
    Contact lag;
    Vec3 n;         ///< unit normal at the lag configuration
    double lambda;  ///< normal force at the lag configuration [N]
    double mu;
    /// Corners of the contact, then the three vertices of the frame, which between cloths are corners too.
    std::array<Index, 7> points;
    std::array<double, 7> c;  ///< of the points
    int frame;                ///< where the frame's vertices begin: they are the last
    bool turns;               ///< false where the frame was a line at the start: Q is the identity
    Vec3 a;                   ///< the gap at the start in the frame there; zero if it does not turn

    std::span<const Index> all_points() const {
      return {points.data(), static_cast<std::size_t>(frame) + 3};
    }
  };
  const std::vector<Entry>& entries() const { return entries_; }

  double energy_change(const double* x0, const double* x1) const;
  void add_gradient(const double* x, double* g) const;

  /// Hessian of one entry: B^T core B, where B dx is the change of s, and what the frame's own turning
  /// adds: the cross product with `turn` between its vertices.
  class Hessian {
   public:
    void add_to(linalg::BlockMatrix& A) const;
    void add_product(const double* z, double* y) const;

   private:
    friend class FrictionSet;
    explicit Hessian(const Entry& entry) : entry_(&entry) {}

    const Entry* entry_;
    std::array<Mat3, 3> B_;  // of the frame's vertices; of all others c I
    Mat3 core_ = Mat3::Zero();
    Vec3 turn_ = Vec3::Zero();
  };

  /// Of the sign of lambda. kPositive is the quadratic majorant (f1/|w|) P, which does not lose its
  /// curvature where a sliding contact would come to rest, and zero where lambda is negative.
  Hessian hessian(const Entry& entry, const double* x, Curvature curvature) const;

  /// y += H z over all vertices.
  void add_hessian_product(const double* x, const double* z, double* y) const;

  /// d/d(theta) of phi = z . grad D, times scale: into `bar` for the parameters (friction, slip,
  /// and, through lambda, kappa, d_hat, thickness, rest shape), into `start_bar` for x_start, and into
  /// `lag_bar` for the lag configuration's positions `x_lag`.
  void add_mixed(const double* x,
                 const double* z,
                 const double* x_lag,
                 double scale,
                 ContactModel::Bar& bar,
                 double* start_bar,
                 double* lag_bar) const;

 private:
  /// The projected displacement w and the law there.
  struct Slip;
  Slip slip(const Entry& entry, const double* x) const;

  const ContactModel* model_ = nullptr;
  const double* x_start_ = nullptr;
  std::vector<Entry> entries_;
};

}  // namespace diffcloth::contact
