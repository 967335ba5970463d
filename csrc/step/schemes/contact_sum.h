#pragma once

#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "contact/contact_potential.h"
#include "step/scheme.h"

namespace diffcloth::step {

/// Potentials of a contact stage except barrier and friction, and the pattern of their Hessian.
struct StagePotentials {
  Proximity& inertia;
  std::vector<Potential*> others;
  solver::PatternCache& patterns;
};

/// The potentials of one friction iteration of a stage.
class ContactSum {
 public:
  /// @param bar          accumulates cotangents of friction; null if unused
  /// @param barrier_bar  likewise, the barrier
  ContactSum(const StagePotentials& stage,
             Problem& problem,
             contact::Detection& detection,
             contact::ContactModel::Bar* bar,
             contact::ContactModel::Bar* barrier_bar)
      : problem_(problem), bar_(bar) {
    if (problem.contact) contact_.emplace(*problem.contact, detection, barrier_bar);
    objective = problem.objective(stage.inertia, stage.others, stage.patterns);
    objective.contact = contact_ ? &*contact_ : nullptr;
  }

  /// Contacts at the start of a motion, which becomes the current point of the contact potential.
  const std::vector<contact::Contact>& contacts_at_start(const std::vector<double>& x) {
    if (contact_) contact_->stand_at_start(x.data());
    return contacts();
  }

  /// Contacts at a point, searched from scratch; it becomes the current point of the contact potential.
  const std::vector<contact::Contact>& contacts_at(const std::vector<double>& x) {
    if (contact_) contact_->look_at(x.data());
    return contacts();
  }

  /// Set the contacts of the contact potential without a search; they must outlive its use.
  void adopt(const std::vector<contact::Contact>& contacts) {
    if (contact_) contact_->adopt(contacts);
  }

  /// Contacts at the current point of the contact potential.
  const std::vector<contact::Contact>& contacts() const {
    static const std::vector<contact::Contact> none;
    return contact_ ? contact_->contacts() : none;
  }

  /// The potentials that exert contact forces.
  std::vector<contact::TouchingPotential*> touching() {
    std::vector<contact::TouchingPotential*> potentials;
    if (objective.contact != nullptr) potentials.push_back(objective.contact);
    if (friction) potentials.push_back(&*friction);
    return potentials;
  }

  /// Include the couplings of all contacts that are possible near a point in factors: patterns then
  /// seldom change, and remain functions of the current point and this one.
  void expect_contacts_near(const std::vector<double>& x) {
    if (!contact_) return;
    linalg::Couplings points;
    contact_->add_couplings_near(x.data(), points);
    objective.expect(std::move(points));
  }

  /// Lag friction at a configuration and its contacts.
  void lag(const std::vector<double>& x, std::vector<contact::Contact> contacts) {
    friction.reset();
    own_lagged_ = std::move(contacts);
    lag_kept(x, own_lagged_);
  }

  /// Likewise, with contacts that outlive the friction.
  void lag_kept(const std::vector<double>& x, const std::vector<contact::Contact>& contacts) {
    objective.take_friction(nullptr);
    friction.reset();
    // If nothing can touch, there are no contacts either.
    if (!problem_.contact || contacts.empty()) return;
    friction.emplace(*problem_.contact, contacts, problem_.moved_from().data(), x.data(), bar_);
    objective.take_friction(&*friction);
  }

  /// Put the tangents of their inputs into barrier and friction, along each direction.
  ///
  /// @param lag  tangents of the lag configuration: all points; they outlive the next add_tangents()
  void set_tangents(std::span<const Tangents> directions,
                    const std::vector<std::vector<double>>& lag) {
    if (!contact_) return;
    std::vector<const contact::ContactModel::Bar*> of_barrier;
    std::vector<contact::FrictionSet::Tangents> of_friction;
    for (std::size_t l = 0; l < directions.size(); ++l) {
      of_barrier.push_back(directions[l].changes_contact ? &directions[l].contact : nullptr);
      of_friction.push_back({.parameters = of_barrier.back(),
                             .start = directions[l].moved_from().data(),
                             .lag = lag[l].data()});
    }
    contact_->set_tangents(std::move(of_barrier));
    if (friction) friction->set_tangents(std::move(of_friction));
  }

  solver::Objective objective;
  std::optional<contact::FrictionPotential> friction;

 private:
  Problem& problem_;
  contact::ContactModel::Bar* bar_;
  std::optional<contact::ContactPotential> contact_;
  std::vector<contact::Contact> own_lagged_;
};

}  // namespace diffcloth::step
