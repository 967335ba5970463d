#include "step/schemes/taken_solves.h"

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "solver/newton.h"

namespace diffcloth::step {

using Array = std::vector<double>;
using contact::Contact;

TakenSolves::TakenSolves(const Taken& step, ContactSum& sum, std::size_t first_factor)
    : step_(step), sum_(sum), first_factor_(first_factor) {
  // The tape may have been changed: hooks on saved tensors may return anything.
  const double count = *step.tape["solves"];
  if (!(count >= 1.0 && count <= step.problem.scene.given.friction_iterations)) {
    throw std::invalid_argument(
        "core: the tape must have one solve or more, and at most one a friction iteration");
  }
  count_ = static_cast<std::size_t>(count);
  found_.resize(count_ + 1);
}

Array TakenSolves::at(std::size_t k) const {
  const Problem& problem = step_.problem;
  if (k == 0) return problem.start;
  return problem.at(step_.tape["iterates"] + (k - 1) * problem.coordinates.size());
}

const std::vector<Contact>& TakenSolves::contacts_at(std::size_t k, const Array& x) {
  static const std::vector<Contact> none;
  if (step_.tape["contacts"][k] == 0.0) return none;
  if (k < step_.kept.contacts.size()) return step_.kept.contacts[k];
  if (!found_[k]) {
    found_[k] = std::make_unique<const std::vector<Contact>>(sum_.contacts_at(x));
  }
  return *found_[k];
}

void TakenSolves::stand(std::size_t k) {
  x_lag_ = at(k);
  x_ = at(k + 1);
  sum_.lag_kept(x_lag_, contacts_at(k, x_lag_));
  sum_.adopt(contacts_at(k + 1, x_));
  step_.problem.coordinates.stand_at(x_.data());
  certificate_ = step_.kept.certificate(first_factor_ + k);
  // The expected contacts are the same for all solves.
  if (!certificate_.factor && sum_.objective.expected.empty()) {
    sum_.expect_contacts_near(step_.problem.start);
  }
  if (!certificate_.factor && !step_.problem.scene.given.options.certify) refine();
}

void TakenSolves::refine() {
  solver::Outcome outcome = solver::minimize(sum_.objective, x_, nullptr, nullptr, step_.context);
  if (!outcome.certified) {
    throw std::domain_error(
        "the end of an uncertified solve is near no solution at which the Hessian is positive "
        "definite: solve with certify = 'always' or a smaller tolerance");
  }
  certificate_ = std::move(outcome.certificate);
}

solver::Certificate certified(solver::LinearSystem& system,
                              const solver::Objective& f,
                              const Array& x,
                              solver::Certificate certificate,
                              Array& gradient) {
  const bool is_kept = certificate.factor != nullptr;
  if (!is_kept || f.coordinates->is_curved()) f.gradient(x.data(), gradient);
  Array p;
  if (!is_kept) certificate = system.certify(x.data(), gradient, p);
  if (!certificate.factor) {
    throw std::domain_error("the Hessian is not positive definite at the solution");
  }
  return certificate;
}

bool is_zero(const Array& values) {
  return std::ranges::all_of(values, [](double value) { return value == 0.0; });
}

}  // namespace diffcloth::step
