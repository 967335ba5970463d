#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "solver/linear_system.h"
#include "step/schemes/contact_sum.h"

namespace diffcloth::step {

/// The solves of a completed contact stage, to be differentiated one by one in any order.
///
/// Contacts and certificates that forward did not keep are recomputed from the tape.
class TakenSolves {
 public:
  /// @param sum           its current point is set by stand()
  /// @param first_factor  place of the stage's factors among the scheme's
  TakenSolves(const Taken& step, ContactSum& sum, std::size_t first_factor);

  std::size_t count() const { return count_; }

  /// Set the sum to the solution of solve k, with friction lagged at the previous configuration.
  void stand(std::size_t k);

  const std::vector<double>& x() const { return x_; }
  const std::vector<double>& x_lag() const { return x_lag_; }

  /// Certificate of the solve; empty if evicted. A solve without certificate is refined and certified
  /// here.
  const solver::Certificate& certificate() const { return certificate_; }

 private:
  /// Minimize from the end of an uncertified solve, as derivatives assume a solution.
  ///
  /// @throws std::domain_error if the solve does not converge
  void refine();

  /// All points at the start (k = 0) or at the end of solve k; contacts_at(): the contacts there.
  std::vector<double> at(std::size_t k) const;
  const std::vector<contact::Contact>& contacts_at(std::size_t k, const std::vector<double>& x);

  const Taken& step_;
  ContactSum& sum_;
  std::size_t first_factor_;
  std::size_t count_;
  std::vector<std::unique_ptr<const std::vector<contact::Contact>>> found_;
  std::vector<double> x_, x_lag_;
  solver::Certificate certificate_;
};

/// The certificate of a solve, recomputed if evicted.
///
/// @param gradient  out: gradient at x, if the certificate is evicted or the coordinates are curved
/// @throws std::domain_error if x is no local minimum
solver::Certificate certified(solver::LinearSystem& system,
                              const solver::Objective& objective,
                              const std::vector<double>& x,
                              solver::Certificate certificate,
                              std::vector<double>& gradient);

bool is_zero(const std::vector<double>& values);

}  // namespace diffcloth::step
