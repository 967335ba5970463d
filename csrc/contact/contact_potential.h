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

/// Search state of one thread: lists that are kept over the solves of a step.
struct Detection {
  /// @param checkpoint_in  polled regularly in long searches, which it may end by an exception; may be
  /// null
  explicit Detection(const BroadPhase& broad_phase_in, const Checkpoint* checkpoint_in = nullptr)
      : broad_phase(broad_phase_in),
        checkpoint(checkpoint_in),
        candidates(broad_phase_in, checkpoint_in) {}

  const BroadPhase& broad_phase;
  const Checkpoint* checkpoint;
  CandidateList candidates;
  BroadPhase::Scratch scratch;
};

/// Potential of contact forces. Tangents along several directions share common intermediate values.
class TouchingPotential : public Potential {
 public:
  /// add_tangent() along several directions, whose tangents are stored in the potential. Each result has
  /// the same bits as if its direction were evaluated alone.
  virtual void add_tangents(const double* x, std::span<double* const> y) const = 0;

  void add_tangent(const double* x, double* y) const final { add_tangents(x, {&y, 1}); }
};

/// The barrier of all contacts as a potential, and their detection.
///
/// The potential acts on the pairs of the last watch(): a motion must be watched before the potential is
/// evaluated at any of its points.
class ContactPotential final : public TouchingPotential {
 public:
  /// @param bar  destination of accumulate(); null if not needed
  ContactPotential(const ContactModel& model, Detection& detection, ContactModel::Bar* bar)
      : model_(model), detection_(detection), bar_(bar) {}

  /// Find every pair that comes within reach on the straight motion x -> to.
  void watch(const double* x, const double* to) {
    detection_.candidates.find(x, to, model_.reach(), detection_.scratch, found_);
  }

  /// Set the current point to the start of a motion.
  void stand_at_start(const double* x) {
    watch(x, x);
    stand_at(x);
  }

  /// Set the current point without a motion from it: finds its pairs alone, and keeps no list for later.
  void look_at(const double* x) {
    detection_.broad_phase.find_at_rest(x, model_.reach(), detection_.scratch, found_.pairs);
    found_.apart.assign(found_.pairs.size(), 0.0);
    stand_at(x);
  }

  /// Append the couplings of all contacts that may soon arise after a point: of the pairs that are near
  /// at x, on surfaces that move.
  void add_couplings_near(const double* x, linalg::Couplings& pairs) const;

  /// Set the current contacts; the caller keeps them alive as long as they are current.
  void adopt(const std::vector<Contact>& contacts) {
    found_.clear();
    adopted_ = &contacts;
    here_.x.clear();
  }

  /// Watch a collision-free part of the straight motion x -> to, and perhaps more; returns the fraction
  /// that is certified.
  ///
  /// A motion that tears a surface sweeps nearly every pair and is blocked early: a short part of it is
  /// watched first, and a longer part only if the short one is collision-free.
  double watch_free(const double* x, const double* to);

  /// Fraction of the watched motion x -> to that is certified to be collision-free.
  double safe_fraction(const double* x, const double* to) const;

  /// Watch the straight motion x -> to, and mark the surfaces that collide on it, or are in contact at
  /// its end; all surfaces if the motion tears one.  [surfaces]
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
  void swap_cotangents(CotangentStore& /*store*/) override {}  // owned by the caller

  /// Tangents of the parameters and the rest shape along each direction, null for a direction without
  /// change; must outlive the calls of add_tangents().
  void set_tangents(std::vector<const ContactModel::Bar*> directions) {
    directions_ = std::move(directions);
  }

 private:
  /// Contact terms and energies at a point.
  struct Measured {
    std::vector<double> x;  ///< positions of all vertices; empty: none
    Near near;
  };
  double largest_coordinate(const double* x) const;
  /// Visit the pairs that may collide on the watched motion x -> to, with their xi, until `visit`
  /// returns false.
  template <class Visit>
  void visit_approaching(const double* x, const double* to, Visit&& visit) const;
  bool is_at(const Measured& measured, const double* x) const;
  void measure(const double* x, Measured& out) const;
  const Near& near_at(const double* x, Measured& scratch) const;

  const ContactModel& model_;
  Detection& detection_;
  ContactModel::Bar* bar_;
  std::vector<const ContactModel::Bar*> directions_;
  Found found_;                                    ///< pairs of the last watch()
  std::vector<Contact> contacts_;                  ///< contacts at here_, if adopted_ is null
  const std::vector<Contact>* adopted_ = nullptr;  ///< contacts given by adopt(), or null
  Measured here_;                                  ///< terms at the current point
  mutable Measured trial_;  ///< terms at the last trial point, which often becomes current
};

/// Lagged friction as a potential of the displacement over the step. See friction_set.h.
class FrictionPotential final : public TouchingPotential {
 public:
  /// @param contacts  contacts of the lag configuration; must outlive the potential
  /// @param x_start   positions at the start of the step; likewise
  /// @param x_lag     positions of the lag configuration, which accumulate() and add_tangents() read
  /// again
  /// @param bar       cotangents of the parameters, for accumulate(); null: only cotangents of positions
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
  void swap_cotangents(CotangentStore& /*store*/) override {}  // owned by the caller

  /// Tangents along each direction; must outlive the calls of add_tangents().
  void set_tangents(std::vector<FrictionSet::Tangents> directions) {
    directions_ = std::move(directions);
  }

  const FrictionSet& set() const { return set_; }

  std::vector<double> start_bar;  ///< cotangent of x_start, all vertices; empty until accumulate()
  std::vector<double> lag_bar;    ///< cotangent of x_lag, likewise

 private:
  FrictionSet set_;
  ContactModel::Bar* bar_;
  std::vector<FrictionSet::Tangents> directions_;
};

}  // namespace diffcloth::contact
