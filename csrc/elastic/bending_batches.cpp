#include "elastic/bending_batches.h"

#include <algorithm>
#include <span>
#include <utility>

#include "elastic/elements.h"
#include "linalg/block_pattern.h"

namespace diffcloth::elastic {
namespace {

void put_element(const Model& model, Index e, int l, bool counts, BendingBatch& batch) {
  const bending::Element element = bending_element(model, e);
  const double weight = counts ? element.weight : 0.0;
  int k = 0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j <= i; ++j, ++k) batch.Q[k][l] = weight * element.form(i, j);
  }
  for (int p = 1; p < 3; ++p) {
    for (int a = 0; a < 2; ++a) batch.g[2 * (p - 1) + a][l] = (*element.g)(p, a);
  }
  batch.damping[l] = element.damping;
  for (k = 0; k < 9; ++k) batch.b[k][l] = element.b->data()[k];
  if (!element.b->isZero(0.0)) batch.curved = 1;
}

void put_points(const Model& model, const Slots& slots, Index e, int l, BendingPoint* points) {
  const bending::Element element = bending_element(model, e);
  const std::span<const Index> own = bending_slots(slots, e);
  for (Index i = 0; i < element.size(); ++i) {
    BendingPoint& point = points[i];
    point.vertex[l] = element.vertices[i];
    for (int a = 0; a < 3; ++a) point.c[a][l] = element.c[3 * i + a];
    for (Index j = 0; j < 3; ++j) {
      point.slot[j][l] = own[linalg::lower(std::max(i, j), std::min(i, j))];
      point.above[j][l] = element.vertices[i] < element.vertices[j] ? -1 : 0;
    }
  }
}

}  // namespace

BendingBatches bending_batches(const Model& model,
                               const Slots& slots,
                               std::vector<Index> elements) {
  const auto points_of = [&](Index e) {
    return static_cast<Index>(model.stencils->element(e).size());
  };
  std::ranges::stable_sort(elements, {}, points_of);
  BendingBatches result;
  const auto count = static_cast<Index>(elements.size());
  for (Index first = 0; first < count;) {
    BendingBatch& batch = result.batches.emplace_back();
    batch.points = points_of(elements[first]);
    batch.first = static_cast<Index>(result.points.size());
    batch.size = 1;
    batch.curved = 0;
    while (batch.size < kBendingLanes && first + batch.size < count &&
           points_of(elements[first + batch.size]) == batch.points) {
      ++batch.size;
    }
    result.points.resize(result.points.size() + static_cast<std::size_t>(batch.points));
    for (int l = 0; l < kBendingLanes; ++l) {
      const Index e = elements[first + std::min(l, batch.size - 1)];
      put_element(model, e, l, l < batch.size, batch);
      put_points(model, slots, e, l, result.points.data() + batch.first);
    }
    first += batch.size;
  }
  result.elements = std::move(elements);
  return result;
}

void put_start_curvatures(const std::vector<Mat3>& curvatures, BendingBatches& bent) {
  const Index* elements = bent.elements.data();
  for (BendingBatch& batch : bent.batches) {
    for (int l = 0; l < kBendingLanes; ++l) {
      const Mat3& b_n = curvatures[elements[std::min(l, batch.size - 1)]];
      for (int k = 0; k < 9; ++k) batch.b_n[k][l] = b_n.data()[k];
    }
    elements += batch.size;
  }
}

}  // namespace diffcloth::elastic
