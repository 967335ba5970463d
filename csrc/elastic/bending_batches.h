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
  std::vector<Index> elements;  ///< of the batches, in their order
};

/// Those elements, sorted by how many vertices they have.
///
/// @param model  with the numbers of its elements in `prepared`
/// The curvature at the start of the step is put by put_start_curvatures().
BendingBatches bending_batches(const Model& model, const Slots& slots, std::vector<Index> elements);

/// @param curvatures  [B] of all elements
void put_start_curvatures(const std::vector<Mat3>& curvatures, BendingBatches& bent);

}  // namespace diffcloth::elastic
