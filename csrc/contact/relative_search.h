#pragma once

#include <span>
#include <vector>

#include "common/interrupt.h"
#include "common/types.h"
#include "contact/broad_phase.h"

namespace diffcloth::contact {

/// Pairs that may come near each other on a motion.
struct Found {
  std::vector<Candidate> pairs;
  std::vector<double> apart;  ///< lower bound of the distance at every time of the motion [m]

  void clear() {
    pairs.clear();
    apart.clear();
  }
  void resize(std::size_t count) {
    pairs.resize(count);
    apart.resize(count);
  }
  void push(const Candidate& pair, double at_least) {
    pairs.push_back(pair);
    apart.push_back(at_least);
  }
};

/// Square of an upper bound of the approach of the two primitives of a pair in two displacements: the
/// largest change of a vector between their corners. The change of a vector between any two other points
/// is a mean of these.
double approach_sq(const Candidate& pair, const double* u_t0, const double* u_t1);

/// Search for pairs by the relative displacement of their parts since a reference.
///
/// Adjacent parts move nearly alike, however far they move: the search prunes them in the hierarchy by
/// boxes of reference positions and boxes of displacements since the reference.
class RelativeSearch {
 public:
  /// @param checkpoint  polled regularly by find(), which it may end by an exception; may be null
  explicit RelativeSearch(const BroadPhase& broad_phase, const Checkpoint* checkpoint)
      : broad_phase_(&broad_phase), checkpoint_(checkpoint) {}

  /// Set the reference configuration.
  void start(const double* reference);

  /// Input of one search along a straight motion.
  struct Wanted {
    const double* reference;  ///< positions passed to start()
    const double* x_t0;
    const double* x_t1;
    const double* u_t0;             ///< displacements since the reference, at x_t0
    const double* u_t1;             ///< and at x_t1
    std::span<const double> reach;  ///< [surfaces] [m]
    double least;                   ///< approach since the reference of unwanted pairs, at most [m]
    double rounding;                ///< bound of the rounding error of a distance [m]
  };

  /// Append all pairs of which two corners have moved by more than `least` against each other, and that
  /// come within the sum of the two reaches at any time of the motion; unordered, with some further
  /// pairs.
  ///
  /// @return number of pairs of leaves that were visited
  std::size_t find(const Wanted& wanted, BroadPhase::Scratch& scratch, Found& out);

 private:
  /// Boxes of a part: reference positions, and displacements at both ends.
  struct Part {
    Box place = kEmptyBox;
    Box u_t0 = kEmptyBox;
    Box u_t1 = kEmptyBox;
  };
  using Parts = std::vector<Part>;  // one per node of a tree
  struct Surface {
    Parts vertices;
    Parts edges;
    Parts faces;
    bool moved = true;  // true if displacements are not all zero
  };

  static bool may_meet(const Part& a, const Part& b, double range, double least);
  void fit_displacements(const Wanted& wanted, Index surface);

  const BroadPhase* broad_phase_;
  const Checkpoint* checkpoint_;
  std::vector<Surface> surfaces_;
};

}  // namespace diffcloth::contact
