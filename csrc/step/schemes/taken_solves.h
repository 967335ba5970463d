#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "solver/linear_system.h"
#include "step/schemes/contact_sum.h"

namespace diffcloth::step {

/// The solves of a contact stage that have been taken, to be differentiated one by one in any order.
///
/// Contacts and certificates that forward has not kept are recomputed from the tape.
class TakenSolves {
 public:
  /// @param sum           stands where the last stand() says
  /// @param first_factor  place of the stage's factors among the scheme's
  TakenSolves(const Taken& step, ContactSum& sum, std::size_t first_factor);

  std::size_t count() const { return count_; }

  /// Let the sum stand at the solution of solve k, with friction taken from the configuration before.
  void stand(std::size_t k);

  const std::vector<double>& x() const { return x_; }
  const std::vector<double>& x_lag() const { return x_lag_; }

  /// Certificate of the solve; empty if evicted. A solve that had none gets it, and its solution is refined.
  const solver::Certificate& certificate() const { return certificate_; }

 private:
  /// Minimize from where an uncertified solve has ended, which its derivative takes for a solution.
  ///
  /// @throws std::domain_error if that does not converge
  void refine();

  /// All points at the start, k = 0, or where solve k has ended; and the contacts there.
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
/// @param gradient  out: that at x, where the certificate is gone or the coordinates are curved
/// @throws std::domain_error where x is no local minimum
solver::Certificate certified(solver::LinearSystem& system,
                              const solver::Objective& objective,
                              const std::vector<double>& x,
                              solver::Certificate certificate,
                              std::vector<double>& gradient);

bool is_zero(const std::vector<double>& values);

}  // namespace diffcloth::step
