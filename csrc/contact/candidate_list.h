#pragma once

#include <span>
#include <vector>

#include "common/types.h"
#include "contact/broad_phase.h"

namespace diffcloth::contact {

/// Candidates that are kept from one search to the next, with a skin around them.
///
/// A solver searches along one short motion after the other. The list keeps the pairs near one
/// configuration together with their distances there, and answers from them for as long as no pair
/// can have come near that is not among them: distances change by no more than the surfaces have
/// moved towards each other, whatever common motion they share. Of what it keeps it answers with the
/// pairs whose own corners have moved that far: near the end of a solve the contacts and little else.
///
/// Only a memory: of what it leaves out nothing comes within reach, so that contacts, energies and
/// collision-free steps are those of BroadPhase::find, to the bit.
class CandidateList {
 public:
  explicit CandidateList(const BroadPhase& broad_phase) : broad_phase_(&broad_phase) {}

  /// Make the list at the start of a motion that will follow, if it is short enough for one.
  void prepare(const double* x_t0,
               const double* x_t1,
               std::span<const double> reach,
               BroadPhase::Scratch& scratch) {
    build(x_t0, x_t1, reach, scratch);
  }

  /// Pairs of the broad phase, sorted; every pair that comes within the sum of the two reaches at
  /// any time of the straight motion is among them.
  ///
  /// @param reach  [surfaces] [m]
  void find(const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            BroadPhase::Scratch& scratch,
            std::vector<Candidate>& out);

  /// How often the list was made anew.
  Index builds() const { return builds_; }

 private:
  /// [surfaces^2] by how much two surfaces can have come closer since the reference, at most; 0 of
  /// those that never touch.
  void measure_approach(const double* x_t0, const double* x_t1, std::vector<double>& out) const;
  double pair_approach_sq(const Candidate& pair, const double* x_t0, const double* x_t1) const;
  bool covers(std::span<const double> approach, std::span<const double> reach) const;
  bool build(const double* x_t0,
             const double* x_t1,
             std::span<const double> reach,
             BroadPhase::Scratch& scratch);

  const BroadPhase* broad_phase_;
  std::vector<double> reference_;  // positions that the list was made at; empty: there is none
  std::vector<double> reach_;      // for which it was made, without the skin
  double skin_ = 0.0;              // of each surface [m]
  double rounding_ = 0.0;          // of distances [m]
  std::vector<Candidate> kept_;
  std::vector<double> distance_;  // of kept_ at the reference [m]
  std::vector<Index> surfaces_;   // of kept_: which pair of surfaces
  std::vector<double> approach_;
  Index builds_ = 0;
};

}  // namespace diffcloth::contact
