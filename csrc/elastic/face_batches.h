#pragma once

#include <vector>

#include "common/types.h"
#include "elastic/stretch_lanes.h"

namespace diffcloth::elastic {

struct Model;
struct Slots;

// Some of a model's triangles in lanes, in their order.

std::vector<StretchBatch> stretch_batches(const Model& model,
                                          const Slots& slots,
                                          const std::vector<Index>& faces);

std::vector<WovenBatch> woven_batches(const Model& model,
                                      const Slots& slots,
                                      const std::vector<Index>& faces);

/// The gradients at the start of the step are set by put_start_gradients().
std::vector<DampingBatch> damping_batches(const Model& model,
                                          const Slots& slots,
                                          const std::vector<Index>& faces);

/// @param faces  faces of the batches
void put_start_gradients(const Model& model,
                         const std::vector<Index>& faces,
                         std::vector<DampingBatch>& batches);

/// All triangles of a model.
///
/// @param shift   d, for the cloths' vertices
/// @param center  c, likewise
/// @param weight  [F] stiffnesses times areas [N m]
std::vector<ChordBatch> chord_batches(const Model& model,
                                      const Slots& slots,
                                      const double* shift,
                                      const double* center,
                                      const std::vector<double>& weight);

}  // namespace diffcloth::elastic
