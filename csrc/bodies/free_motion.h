#pragma once

#include <vector>

#include <Eigen/Core>

#include "bodies/mechanisms.h"

namespace diffcloth::bodies {

/// Velocities nu = (dc/dt, omega, dq/dt) of a tree of links over a step of which only what is given
/// knows anything: those with
///
///   r(nu) = p(q_mid, nu) - h/2 s(q_mid, nu) - given = 0
///
/// in the rows that are solved for, where p is the momentum, s = dT/dq the slope of the kinetic energy
/// at constant nu, and q_mid the middle of the step. The root link is described by its center of mass
/// c and orientation R.
///
/// The equation, its derivatives and what follows from them are in diffcloth_torch/dynamics; here it
/// is solved, which takes a few evaluations of many small products.
class FreeMotion {
 public:
  /// @param links       any order; a coordinate is the place of a joint among the J
  /// @param order       of the links, parents before their children
  /// @param solved      rows of nu that are unknown
  /// @param root_moves  whether the root follows its velocity, or stays
  FreeMotion(std::vector<Link> links,
             std::vector<Index> order,
             Index joint_count,
             std::vector<Index> solved,
             bool root_moves,
             double dt);

  /// One environment: arrays of the sizes in brackets, matrices row after row.
  struct Given {
    const double* mass;           ///< [L] kg
    const double* center;         ///< [L, 3] in the links' frames, m
    const double* inertia;        ///< [L, 3, 3] about the centers, in the links' axes, kg m^2
    const double* armature;       ///< [J] kg m^2 or kg
    const double* root_center;    ///< [3] at the start
    const double* root_rotation;  ///< [3, 3]
    const double* joints;         ///< [J]
    const double* known;          ///< [6 + J] nu where it is prescribed, zero elsewhere
    const double* momentum;       ///< [6 + J]
  };

  /// Solve by Broyden's method from the velocities that M(q_n) alone would give.
  ///
  /// @param velocities  [solved]
  /// @return whether they were found
  bool solve(const Given& given, double* velocities) const;

  Index link_count() const { return static_cast<Index>(links_.size()); }
  Index joint_count() const { return joint_count_; }
  Index solved_count() const { return static_cast<Index>(solved_.size()); }

 private:
  struct Configuration;
  struct Rates;

  Configuration start(const Given& given) const;
  Configuration middle(const Given& given, const Eigen::VectorXd& nu) const;
  Rates rates(const Given& given, const Configuration& at, const Eigen::VectorXd& nu) const;
  Eigen::VectorXd residual(const Given& given, const Eigen::VectorXd& nu) const;
  Eigen::VectorXd complete(const Given& given, const Eigen::VectorXd& solved) const;

  std::vector<Link> links_;
  std::vector<Index> order_;
  Index joint_count_;
  std::vector<Index> solved_;
  bool root_moves_;
  double dt_;
};

}  // namespace diffcloth::bodies
