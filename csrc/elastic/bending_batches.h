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
};

/// Those elements, sorted by how many vertices they have.
///
/// @param model  with the numbers of its elements in `prepared`
BendingBatches bending_batches(const Model& model, const Slots& slots, std::vector<Index> elements);

}  // namespace diffcloth::elastic
