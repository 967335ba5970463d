// The comparison of two groups of boxes, written once over packs of `kPack` doubles. Everything here is in an
// anonymous namespace, for the reason given in linalg/dense_kernels_impl.h.

#pragma once

#include "contact/box_group.h"

namespace diffcloth::contact {
namespace {

using Pack = double __attribute__((vector_size(8 * kPack)));
using Mask = long long __attribute__((vector_size(8 * kPack)));
using Stored = double __attribute__((vector_size(8 * kPack), aligned(8), may_alias));

std::uint32_t find_near_boxes(const BoxGroup& a, const BoxGroup& b, double range) {
  Mask found = {};  // the bits of each lane; no bit is set in two lanes
  for (int first = 0; first < kBoxGroup; first += kPack) {
    Mask bit;
    for (int l = 0; l < kPack; ++l) bit[l] = 1LL << (first + l);
    for (int p = 0; p < kBoxGroup; ++p) {
      Pack sum = {};
      Mask near = bit << (kBoxGroup * p);
      for (int k = 0; k < 3; ++k) {
        const Pack lo = *reinterpret_cast<const Stored*>(b.lo[k] + first);
        const Pack hi = *reinterpret_cast<const Stored*>(b.hi[k] + first);
        near &= (a.lo[k][p] <= hi) & (lo <= a.hi[k][p]);
        const Pack over = a.lo[k][p] - hi;
        const Pack under = lo - a.hi[k][p];
        const Pack apart = (over > under ? over : under) + range;
        sum += apart > 0.0 ? apart * apart : Pack{};
      }
      found |= near & ~(sum > range * range);
    }
  }
  std::uint32_t result = 0;
  for (int l = 0; l < kPack; ++l) result |= static_cast<std::uint32_t>(found[l]);
  return result;
}

constexpr NearBoxes kKernels = find_near_boxes;

}  // namespace
}  // namespace diffcloth::contact
