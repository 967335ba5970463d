#pragma once

#include <vector>

#include "common/types.h"
#include "elastic/bending_lanes.h"

namespace diffcloth::elastic {

struct Model;
struct Slots;

/// Bending elements in lanes.
struct BendingBatches {
  std::vector<BendingBatch> batches;
  std::vector<BendingPoint> points;
  std::vector<Index> elements;  ///< elements of the batches, in their order
};

/// Batches of elements, sorted by number of vertices. put_start_curvatures() sets the curvature at the start
/// of the step.
///
/// @param model  with the quantities of its elements in `prepared`
BendingBatches bending_batches(const Model& model, const Slots& slots, std::vector<Index> elements);

/// @param curvatures  [B] of all elements
void put_start_curvatures(const std::vector<Mat3>& curvatures, BendingBatches& bent);

}  // namespace diffcloth::elastic
