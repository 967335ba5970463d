#pragma once

#include <vector>

#include "step/nodal/stage.h"
#include "step/scheme.h"

namespace diffcloth::step {

/// The stage of a scheme without the barrier: inertia and all potentials of the cloths, with dry
/// frictional contact at nodes if there is any. The tape stores its positions as "elastic".
class ElasticStage {
 public:
  explicit ElasticStage(Problem& problem) : problem_(problem), nodes_(problem) {}

  bool has_contacts() const { return nodes_.has_contacts(); }

  /// All points at the end of the stage; its forces are added.
  std::vector<double> forward(const Forward& step, const Forces& forces) const;

  /// @param g  of each loss, cotangent of the rows at its end
  void backward(const Backward& step, const std::vector<std::vector<double>>& g) const;

  /// Change of all points at its end, along each direction.
  std::vector<std::vector<double>> tangent(const Pushforward& step) const;

 private:
  Problem& problem_;
  NodalStage nodes_;
};

}  // namespace diffcloth::step
