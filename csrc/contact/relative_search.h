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
  std::vector<double> apart;  ///< at every time of the motion their distance is at least this [m]

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

/// Square of how much the two primitives of a pair can have come closer in two displacements, at most:
/// the largest change of a vector between their corners. That between any two of their points is a
/// mean of those.
double approach_sq(const Candidate& pair, const double* u_t0, const double* u_t1);

/// Search for pairs by how their parts have moved against each other since a reference.
///
/// What lies side by side moves nearly alike, however far it goes: it is left out with the boxes around
/// it, by the boxes of positions at the reference and those of displacements since then.
class RelativeSearch {
 public:
  /// @param checkpoint  passed now and then by find(), which it may end by an exception; may be null
  explicit RelativeSearch(const BroadPhase& broad_phase, const Checkpoint* checkpoint)
      : broad_phase_(&broad_phase), checkpoint_(checkpoint) {}

  /// Begin at a configuration.
  void start(const double* reference);

  /// What is looked for on a straight motion.
  struct Wanted {
    const double* reference;  ///< of start()
    const double* x_t0;
    const double* x_t1;
    const double* u_t0;             ///< displacements since the reference, at x_t0
    const double* u_t1;             ///< and at x_t1
    std::span<const double> reach;  ///< [surfaces] [m]
    double least;                   ///< approach since the reference up to which none is wanted [m]
    double rounding;                ///< of a distance [m]
  };

  /// Append all pairs of which two corners have moved by more than `least` against each other, and that
  /// come within the sum of the two reaches at any time of the motion; in any order, and some others.
  ///
  /// @return how many pairs of leaves were looked at
  std::size_t find(const Wanted& wanted, BroadPhase::Scratch& scratch, Found& out);

 private:
  /// Boxes around a part: its positions at the reference, and its displacements at both ends.
  struct Part {
    Box place = kEmptyBox;
    Box u_t0 = kEmptyBox;
    Box u_t1 = kEmptyBox;
  };
  using Parts = std::vector<Part>;  // of the nodes of a tree
  struct Surface {
    Parts vertices;
    Parts edges;
    Parts faces;
    bool moved = true;  // displacements are not all zero
  };

  static bool may_meet(const Part& a, const Part& b, double range, double least);
  void fit_displacements(const Wanted& wanted, Index surface);

  const BroadPhase* broad_phase_;
  const Checkpoint* checkpoint_;
  std::vector<Surface> surfaces_;
};

}  // namespace diffcloth::contact
