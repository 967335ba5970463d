#include "elastic/face_batches.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <numeric>

#include "elastic/elements.h"
#include "elastic/face_terms.h"
#include "linalg/block_pattern.h"

namespace diffcloth::elastic {
namespace {

/// Triangles in lanes, in their order.
class FaceLanes {
 public:
  FaceLanes(const Model& model, const Slots& slots, const std::vector<Index>& faces)
      : model_(model), slots_(slots), faces_(faces) {}

  std::size_t size() const { return (faces_.size() + kStretchLanes - 1) / kStretchLanes; }

  /// The face in a lane; unused lanes repeat the last face.
  Index face(std::size_t batch, int lane) const {
    const std::size_t at = kStretchLanes * batch + static_cast<std::size_t>(lane);
    return faces_[std::min(at, faces_.size() - 1)];
  }

  /// @param axes  (f) -> axes of the shape gradients, as columns
  template <class Axes>
  FaceBatch batch(std::size_t b, Axes&& axes) const {
    FaceBatch batch;
    const std::size_t rest = faces_.size() - kStretchLanes * b;
    batch.size = std::min(kStretchLanes, static_cast<int>(rest));
    for (int l = 0; l < kStretchLanes; ++l) put(face(b, l), axes(face(b, l)), l, batch);
    return batch;
  }

 private:
  void put(Index f, const Mat2& axes, int l, FaceBatch& batch) const {
    const std::array<Index, 3>& face = model_.topology->faces[f];
    const mesh::ShapeGradient g = model_.rest->shape_gradient[f] * axes;
    const Index* const face_slots = slots_.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f);
    std::array<int, 3> corner{0, 1, 2};
    std::ranges::sort(corner, {}, [&](int p) { return face[p]; });
    int k = 0;
    for (int p = 0; p < 3; ++p) {
      batch.vertex[p][l] = face[corner[p]];
      for (int q = 0; q <= p; ++q, ++k) {
        const auto [low, high] = std::minmax(corner[p], corner[q]);
        batch.slot[k][l] = face_slots[linalg::lower(high, low)];
      }
    }
    for (int p = 1; p < 3; ++p) {
      for (int a = 0; a < 2; ++a) batch.g[2 * (p - 1) + a][l] = g(corner[p], a);
    }
  }

  const Model& model_;
  const Slots& slots_;
  const std::vector<Index>& faces_;
};

/// @param weave  (f) -> weave of a face, times its area
template <class WeaveOf>
std::vector<WovenBatch> batches_of(const FaceLanes& faces, WeaveOf&& weave) {
  std::vector<WovenBatch> batches;
  batches.reserve(faces.size());
  for (std::size_t b = 0; b < faces.size(); ++b) {
    const auto axes = [&](Index f) { return weave(f).axes(); };
    WovenBatch& batch = batches.emplace_back();
    batch.faces = faces.batch(b, axes);
    for (int l = 0; l < kStretchLanes; ++l) {
      const Weave K = weave(faces.face(b, l));
      batch.stiffness[0][l] = K.warp;
      batch.stiffness[1][l] = K.shear;
      batch.stiffness[2][l] = K.weft;
    }
  }
  return batches;
}

}  // namespace

std::vector<StretchBatch> stretch_batches(const Model& model,
                                          const Slots& slots,
                                          const std::vector<Index>& faces) {
  const FaceLanes lanes(model, slots, faces);
  std::vector<StretchBatch> batches;
  batches.reserve(lanes.size());
  for (std::size_t b = 0; b < lanes.size(); ++b) {
    StretchBatch& batch = batches.emplace_back();
    batch.faces = lanes.batch(b, [](Index) { return Mat2(Mat2::Identity()); });
    for (int l = 0; l < kStretchLanes; ++l) {
      batch.weight[l] = stretch_weight(model, lanes.face(b, l));
    }
  }
  return batches;
}

std::vector<WovenBatch> woven_batches(const Model& model,
                                      const Slots& slots,
                                      const std::vector<Index>& faces) {
  return batches_of(FaceLanes(model, slots, faces),
                    [&](Index f) { return stretch_weave(model, f); });
}

std::vector<DampingBatch> damping_batches(const Model& model,
                                          const Slots& slots,
                                          const std::vector<Index>& faces) {
  std::vector<DampingBatch> batches;
  for (const WovenBatch& batch : batches_of(FaceLanes(model, slots, faces),
                                            [&](Index f) { return damping_weave(model, f); })) {
    batches.push_back({.woven = batch, .start = {}, .gained = {}});
  }
  return batches;
}

void put_start_gradients(const Model& model,
                         const std::vector<Index>& faces,
                         std::vector<DampingBatch>& batches) {
  for (std::size_t i = 0; i < kStretchLanes * batches.size(); ++i) {
    const Index f = faces[std::min(i, faces.size() - 1)];
    const Mat2 axes = damping_weave(model, f).axes();
    const damping::Start start = damping_start(model, f);
    const Mat32 F = start.F_n * axes;
    DampingBatch& batch = batches[i / kStretchLanes];
    const std::size_t lane = i % kStretchLanes;
    for (int k = 0; k < 6; ++k) batch.start[k][lane] = F.data()[k];
    if (start.ahead == 0.0) continue;
    const Mat2 gained = start.ahead * damping::strain(start.F_a * axes, F);
    batch.gained[0][lane] = gained(0, 0);
    batch.gained[1][lane] = gained(0, 1);
    batch.gained[2][lane] = gained(1, 1);
  }
}

std::vector<ChordBatch> chord_batches(const Model& model,
                                      const Slots& slots,
                                      const double* shift,
                                      const double* center,
                                      const std::vector<double>& weight) {
  std::vector<Index> all(weight.size());
  std::iota(all.begin(), all.end(), 0);
  const FaceLanes lanes(model, slots, all);
  std::vector<ChordBatch> batches;
  batches.reserve(lanes.size());
  for (std::size_t b = 0; b < lanes.size(); ++b) {
    ChordBatch& batch = batches.emplace_back();
    batch.faces = lanes.batch(b, [](Index) { return Mat2(Mat2::Identity()); });
    for (int l = 0; l < kStretchLanes; ++l) {
      const Index f = lanes.face(b, l);
      batch.weight[l] = weight[f];
      const Mat32 D = face_gradient(model, f, shift);
      const Mat32 C = face_gradient(model, f, center);
      for (int k = 0; k < 6; ++k) {
        batch.shift[k][l] = D.data()[k];
        batch.center[k][l] = C.data()[k];
      }
    }
  }
  return batches;
}

}  // namespace diffcloth::elastic
