#pragma once

#include <span>
#include <vector>

#include "common/types.h"
#include "contact/broad_phase.h"
#include "contact/relative_search.h"

namespace diffcloth::contact {

/// Candidates that are kept from one search to the next, with a skin around them.
///
/// A solver searches along one motion after the other. The list keeps the pairs near one configuration
/// together with their distances there, and answers with those of them whose own corners have moved that
/// far. Distances change by no more than the surfaces have moved towards each other, whatever common
/// motion they share, so that for short motions nothing else can have come near. For longer ones,
/// RelativeSearch finds what has. From such a wide list a near one is made where short motions follow,
/// as near the end of a solve: it holds the contacts and little else.
///
/// Only a memory: of what it leaves out nothing comes within reach, so that contacts, energies and
/// collision-free steps are those of BroadPhase::find, to the bit.
class CandidateList {
 public:
  /// @param checkpoint  see RelativeSearch
  explicit CandidateList(const BroadPhase& broad_phase, const Checkpoint* checkpoint = nullptr)
      : broad_phase_(&broad_phase), relative_search_(broad_phase, checkpoint) {}

  /// Make the list at the start of a motion that will follow.
  void prepare(const double* x_t0,
               const double* x_t1,
               std::span<const double> reach,
               BroadPhase::Scratch& scratch) {
    build(x_t0, x_t1, reach, scratch);
  }

  /// Pairs of the broad phase, sorted; every pair that comes within the sum of the two reaches at
  /// any time of the straight motion is among them. How far apart they stay at least is known by how near
  /// they have been, and how far they have moved against each other since: most pairs of a short motion
  /// need no more to be known to stay apart.
  ///
  /// @param reach  [surfaces] [m]
  void find(const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            BroadPhase::Scratch& scratch,
            Found& out);

  /// The pairs of wanted surfaces whose distance at a point is at most the sum of the two reaches, widened;
  /// sorted. Quick where the list was made. The list stays as it is.
  ///
  /// @param widened  how much more each reach is than that of the list [m]
  /// @param wanted   [surfaces]
  void find_at(const double* x,
               std::span<const double> reach,
               double widened,
               std::span<const char> wanted,
               BroadPhase::Scratch& scratch,
               std::vector<Candidate>& out);

  /// How often the wide list was made anew.
  Index builds() const { return builds_; }

 private:
  /// All pairs within the sum of their reaches and two skins at a reference.
  struct Kept {
    std::vector<double> reference;  // positions; empty: there is none
    double skin = 0.0;              // of each surface [m]
    std::vector<Candidate> pairs;
    std::vector<double> distance;  // at the reference [m]
    std::ptrdiff_t middle = 0;     // where the pairs of edges begin
    std::vector<Index> surfaces;   // which pair of surfaces
  };

  double measure_approach(const double* reference, const double* x_t0, const double* x_t1);
  void build(const double* x_t0,
             const double* x_t1,
             std::span<const double> reach,
             BroadPhase::Scratch& scratch);
  void build_near(const double* x_t0, double approach, BroadPhase::Scratch& scratch);
  void keep_near_ones(Kept& kept) const;
  void measure_deviations();
  void cull(const Kept& kept,
            const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            Found& out);
  void find_wide(const double* x_t0,
                 const double* x_t1,
                 std::span<const double> reach,
                 double widened,
                 BroadPhase::Scratch& scratch,
                 Found& out);

  const BroadPhase* broad_phase_;
  RelativeSearch relative_search_;
  std::vector<double> reach_;  // for which the lists were made, without the skin
  double rounding_ = 0.0;      // of distances [m]
  Kept wide_;
  Kept near_;
  bool has_parts_ = false;        // relative_search_ has started at the reference of wide_
  std::size_t looked_at_ = 0;     // by searches beside wide_
  std::vector<double> approach_;  // [surfaces^2] of measure_approach()
  std::vector<Vec3> mean_t0_;     // [surfaces] likewise: mean displacements since the reference
  std::vector<Vec3> mean_t1_;
  std::vector<double> u_t0_;  // scratch of cull(): displacements since the reference
  std::vector<double> u_t1_;
  std::vector<double> deviation_;   // of the vertices from those means, at most
  std::vector<double> mean_apart_;  // [surfaces^2] how much two of them differ, at most
  std::vector<Index> maybe_;
  Found found_;
  std::vector<double> with_skin_;  // [surfaces] scratch
  Index builds_ = 0;
};

}  // namespace diffcloth::contact
