#pragma once

#include <span>
#include <utility>
#include <vector>

#include "common/interrupt.h"
#include "contact/broad_phase.h"
#include "contact/candidate_list.h"
#include "contact/contact_set.h"
#include "contact/friction_set.h"
#include "potential/potential.h"

namespace diffcloth::contact {

/// What one thread searches with: lists that are kept over the solves of a step.
struct Detection {
  /// @param checkpoint_in  passed now and then in long searches, which it may end by an exception; may be null
  explicit Detection(const BroadPhase& broad_phase_in, const Checkpoint* checkpoint_in = nullptr)
      : broad_phase(broad_phase_in),
        checkpoint(checkpoint_in),
        candidates(broad_phase_in, checkpoint_in) {}

  const BroadPhase& broad_phase;
  const Checkpoint* checkpoint;
  CandidateList candidates;
  BroadPhase::Scratch scratch;
};

/// A potential that contact forces are of. The directions of a tangent share what they have in common.
class TouchingPotential : public Potential {
 public:
  /// add_tangent() along several directions, whose tangents are in the potential, each with the bits that it
  /// has alone.
  virtual void add_tangents(const double* x, std::span<double* const> y) const = 0;

  void add_tangent(const double* x, double* y) const final { add_tangents(x, {&y, 1}); }
};

/// The barrier of all contacts as a potential, and the detection of what may come into contact.
///
/// It acts on the pairs that the last watch() has found: a motion must be watched before the
/// potential is asked about any point of it.
class ContactPotential final : public TouchingPotential {
 public:
  /// @param bar  where accumulate() adds; null where nobody asks for it
  ContactPotential(const ContactModel& model, Detection& detection, ContactModel::Bar* bar)
      : model_(model), detection_(detection), bar_(bar) {}

  /// Find every pair that comes within reach on the straight motion x -> to.
  void watch(const double* x, const double* to) {
    detection_.candidates.find(x, to, model_.reach(), detection_.scratch, found_);
  }

  /// Stand at a point that a motion leads from.
  void stand_at_start(const double* x) {
    watch(x, x);
    stand_at(x);
  }

  /// Stand at a point that no motion leads from: its pairs alone, without a list for later.
  void look_at(const double* x) {
    detection_.broad_phase.find_at_rest(x, model_.reach(), detection_.scratch, found_.pairs);
    found_.apart.assign(found_.pairs.size(), 0.0);
    stand_at(x);
  }

  /// Append the couplings of all contacts that there may soon be after a point: of the pairs that are near
  /// at x, on surfaces that move.
  void add_couplings_near(const double* x, linalg::Couplings& pairs) const;

  /// Stand at a point whose contacts are known; they outlive the stand.
  void adopt(const std::vector<Contact>& contacts) {
    found_.clear();
    adopted_ = &contacts;
    here_.x.clear();
  }

  /// Watch the straight motion x -> to as far as it is free of collisions, and perhaps further; returns the
  /// fraction that is certified so.
  ///
  /// A motion that tears a surface to pieces takes everything past everything, and is blocked long before: of
  /// such a one a short part is watched, and a longer one only if that is free.
  double watch_free(const double* x, const double* to);

  /// Fraction of the watched motion x -> to that is certified free of collisions.
  double safe_fraction(const double* x, const double* to) const;

  /// Watch the straight motion x -> to, and find the surfaces that collide on it, or are in contact at its
  /// end; all of them where it tears one to pieces.  [surfaces]
  std::vector<char> meeting(const double* x, const double* to);

  const ContactModel& model() const { return model_; }
  const std::vector<Contact>& contacts() const {
    return adopted_ != nullptr ? *adopted_ : contacts_;
  }

  void stand_at(const double* x) override;
  double energy(const double* x) const override;
  double energy_change(const double* x, const double* to) const override;
  void add_gradient(const double* x, double* g) const override;
  void add_couplings(linalg::Couplings& pairs) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override {
    add_hessian_products(x, {.z = {&z, 1}, .y = {&y, 1}});
  }
  void add_hessian_products(const double* x, const Products& products) const override;
  void add_held_product(const double* x, const double* z, double* y) const override;
  void add_left_out_products(const double* x,
                             Curvature curvature,
                             const Products& products) const override;
  void accumulate(const double* x, const double* z) override;
  void add_tangents(const double* x, std::span<double* const> y) const override;
  void swap_cotangents(CotangentStore& /*store*/) override {}  // they are the caller's

  /// Tangents of the parameters and the rest shape along each direction, null where none changes; they
  /// outlive the calls of add_tangents().
  void set_tangents(std::vector<const ContactModel::Bar*> directions) {
    directions_ = std::move(directions);
  }

 private:
  /// What is near at a point.
  struct Measured {
    std::vector<double> x;  ///< all vertices; empty where nothing is known
    Near near;
  };
  double largest_coordinate(const double* x) const;
  /// Visit the pairs that may collide on the watched motion x -> to, and their xi, as long as it is wanted.
  template <class Visit>
  void visit_approaching(const double* x, const double* to, Visit&& visit) const;
  bool is_at(const Measured& measured, const double* x) const;
  void measure(const double* x, Measured& out) const;
  const Near& near_at(const double* x, Measured& scratch) const;

  const ContactModel& model_;
  Detection& detection_;
  ContactModel::Bar* bar_;
  std::vector<const ContactModel::Bar*> directions_;
  Found found_;                                    ///< by the last watch()
  std::vector<Contact> contacts_;                  ///< that were found
  const std::vector<Contact>* adopted_ = nullptr;  ///< where the potential stands at these
  Measured here_;                                  ///< where the potential stands
  mutable Measured trial_;  ///< where the energy was last asked for: often where it stands next
};

/// Lagged friction as a potential of the displacement over the step. See friction_set.h.
class FrictionPotential final : public TouchingPotential {
 public:
  /// @param contacts  of the lag configuration; they outlive the potential
  /// @param x_start   positions at the start of the step; likewise
  /// @param x_lag     those of the lag configuration, which accumulate() and add_tangents() read again
  /// @param bar       cotangents of the parameters, for accumulate(); null if it differentiates by points alone
  FrictionPotential(const ContactModel& model,
                    const std::vector<Contact>& contacts,
                    const double* x_start,
                    const double* x_lag,
                    ContactModel::Bar* bar)
      : set_(model, contacts, x_start, x_lag), bar_(bar) {}

  double energy(const double* /*x*/) const override { return 0.0; }
  double energy_change(const double* x, const double* to) const override {
    return set_.energy_change(x, to);
  }
  void add_gradient(const double* x, double* g) const override { set_.add_gradient(x, g); }
  void add_couplings(linalg::Couplings& pairs) const override;
  void add_hessian(const double* x, Curvature curvature, linalg::BlockMatrix& A) const override;
  void add_hessian_product(const double* x, const double* z, double* y) const override {
    add_hessian_products(x, {.z = {&z, 1}, .y = {&y, 1}});
  }
  void add_hessian_products(const double* x, const Products& products) const override;
  void add_held_product(const double* x, const double* z, double* y) const override;
  void add_left_out_products(const double* x,
                             Curvature curvature,
                             const Products& products) const override;
  void update_duals(const double* x, const double* p, double alpha, const double* to) override {
    set_.update_duals(x, p, alpha, to);
  }
  bool has_duals(const double* x) const override { return set_.has_duals(x); }
  double force_change(const double* x, const double* p) const override {
    return set_.force_change(x, p);
  }

  /// Expect the motion from the start of the step to another point: see FrictionSet::expect().
  void expect(const double* x, const double* to) { set_.expect(x, to); }
  void accumulate(const double* x, const double* z) override;
  void add_tangents(const double* x, std::span<double* const> y) const override;
  void swap_cotangents(CotangentStore& /*store*/) override {}  // the caller takes and swaps them

  /// Tangents along each direction; they outlive the calls of add_tangents().
  void set_tangents(std::vector<FrictionSet::Tangents> directions) {
    directions_ = std::move(directions);
  }

  const FrictionSet& set() const { return set_; }

  std::vector<double> start_bar;  ///< of x_start, all vertices; empty until accumulate()
  std::vector<double> lag_bar;    ///< of x_lag, likewise

 private:
  FrictionSet set_;
  ContactModel::Bar* bar_;
  std::vector<FrictionSet::Tangents> directions_;
};

}  // namespace diffcloth::contact
