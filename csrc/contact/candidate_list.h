#pragma once

#include <span>
#include <vector>

#include "common/types.h"
#include "contact/broad_phase.h"
#include "contact/relative_search.h"

namespace diffcloth::contact {

/// Candidates that are kept from one search to the next, with a skin around them.
///
/// A solver searches along one motion after another. The list stores the pairs near one reference
/// configuration with their distances there. A search returns the stored pairs whose corners have moved
/// enough since the reference to come within reach. A distance decreases by no more than the two
/// surfaces have approached each other, whatever common motion they share; a short motion therefore
/// cannot bring any other pair within reach. For longer motions RelativeSearch finds the missing pairs.
/// If short motions follow, as near the end of a solve, a near list is extracted from the wide one: it
/// holds the contacts and little else.
///
/// The list affects speed only: a pair that is left out never comes within reach, so that contacts,
/// energies and collision-free steps equal the results with BroadPhase::find, to the bit.
class CandidateList {
 public:
  /// @param checkpoint  see RelativeSearch
  explicit CandidateList(const BroadPhase& broad_phase, const Checkpoint* checkpoint = nullptr)
      : broad_phase_(&broad_phase), relative_search_(broad_phase, checkpoint) {}

  /// Build the list at the start of a motion that will follow.
  void prepare(const double* x_t0,
               const double* x_t1,
               std::span<const double> reach,
               BroadPhase::Scratch& scratch) {
    build(x_t0, x_t1, reach, scratch);
  }

  /// Pairs of the broad phase, sorted; includes every pair that comes within the sum of the two reaches
  /// at any time of the straight motion. Each pair has a lower bound of its distance on the motion, from
  /// its distance at the reference and its relative motion since then. In a short motion this bound
  /// alone excludes most pairs from contact.
  ///
  /// @param reach  [surfaces] [m]
  void find(const double* x_t0,
            const double* x_t1,
            std::span<const double> reach,
            BroadPhase::Scratch& scratch,
            Found& out);

  /// Pairs of wanted surfaces whose distance at x is at most the sum of their widened reaches; sorted.
  /// Fast if the wide list was built at x with these reaches. The list is not changed.
  ///
  /// @param widened  margin that is added to each reach [m]
  /// @param wanted   [surfaces] nonzero for wanted surfaces
  void find_at(const double* x,
               std::span<const double> reach,
               double widened,
               std::span<const char> wanted,
               BroadPhase::Scratch& scratch,
               std::vector<Candidate>& out);

  /// Number of times that the wide list was built.
  Index builds() const { return builds_; }

 private:
  /// All pairs within the sum of their reaches and two skins at a reference.
  struct Kept {
    std::vector<double> reference;  // positions; empty: no list
    double skin = 0.0;              // of each surface [m]
    std::vector<Candidate> pairs;
    std::vector<double> distance;  // at the reference [m]
    std::ptrdiff_t middle = 0;     // index of the first edge-edge pair
    std::vector<Index> surfaces;   // pair of surfaces of each pair, as an index into [surfaces^2]
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
  std::vector<double> reach_;  // reaches of the lists, without the skin
  double rounding_ = 0.0;      // bound of the rounding error of a distance [m]
  Kept wide_;
  Kept near_;
  bool has_parts_ = false;        // true if relative_search_ was started at the reference of wide_
  std::size_t looked_at_ = 0;     // pairs of leaves visited since wide_ was built
  std::vector<double> approach_;  // [surfaces^2] result of measure_approach()
  std::vector<Vec3> mean_t0_;     // [surfaces] mean displacements since the reference
  std::vector<Vec3> mean_t1_;
  std::vector<double> u_t0_;  // scratch of cull(): displacements since the reference
  std::vector<double> u_t1_;
  std::vector<double> deviation_;   // upper bound of each vertex's deviation from these means
  std::vector<double> mean_apart_;  // [surfaces^2] upper bound of the difference of two means
  std::vector<Index> maybe_;
  Found found_;
  std::vector<double> with_skin_;  // [surfaces] scratch
  Index builds_ = 0;
};

}  // namespace diffcloth::contact
