// Blocks of eight elements side by side, added to a matrix: see stretch_lanes_impl.h. Needs kPack.

#pragma once

#include <cstddef>
#include <cstdint>

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

constexpr int kBlockLanes = 8;

using Pack = double __attribute__((vector_size(8 * kPack)));
using StoredPack = double __attribute__((vector_size(8 * kPack), aligned(8), may_alias));

/// Transpose a square of packs: as many packs as each has numbers.
template <class V, int Size>
DIFFCLOTH_INLINE void transpose(V (&v)[Size]) {
  if constexpr (Size == 8) {
    V u[8];
    for (int i = 0; i < 8; i += 2) {
      u[i] = __builtin_shufflevector(v[i], v[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
      u[i + 1] = __builtin_shufflevector(v[i], v[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i += 4) {
      for (int k = 0; k < 2; ++k) {
        v[i + k] = __builtin_shufflevector(u[i + k], u[i + k + 2], 0, 1, 8, 9, 4, 5, 12, 13);
        v[i + k + 2] = __builtin_shufflevector(u[i + k], u[i + k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
      }
    }
    for (int k = 0; k < 4; ++k) {
      u[k] = __builtin_shufflevector(v[k], v[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
      u[k + 4] = __builtin_shufflevector(v[k], v[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
    for (int k = 0; k < 8; ++k) v[k] = u[k];
  } else if constexpr (Size == 4) {
    V u[4];
    for (int i = 0; i < 4; i += 2) {
      u[i] = __builtin_shufflevector(v[i], v[i + 1], 0, 4, 2, 6);
      u[i + 1] = __builtin_shufflevector(v[i], v[i + 1], 1, 5, 3, 7);
    }
    for (int k = 0; k < 2; ++k) {
      v[k] = __builtin_shufflevector(u[k], u[k + 2], 0, 1, 4, 5);
      v[k + 2] = __builtin_shufflevector(u[k], u[k + 2], 2, 3, 6, 7);
    }
  } else {
    static_assert(Size == 2);
    const V first = __builtin_shufflevector(v[0], v[1], 0, 2);
    v[1] = __builtin_shufflevector(v[0], v[1], 1, 3);
    v[0] = first;
  }
}

/// Transpose the blocks of some elements.
///
/// @param which  -1 for these elements, 0 for all others
DIFFCLOTH_INLINE void transpose_blocks(const std::int64_t (&which)[kBlockLanes],
                                       double (*h)[kBlockLanes]) {
  using Mask = long long __attribute__((vector_size(8 * kPack)));
  using StoredMask = long long __attribute__((vector_size(8 * kPack), aligned(8), may_alias));
  constexpr int kAcross[3][2] = {{1, 3}, {2, 6}, {5, 7}};
  for (int first = 0; first < kBlockLanes; first += kPack) {
    const Mask chosen = *reinterpret_cast<const StoredMask*>(which + first);
    for (const auto& [i, j] : kAcross) {
      auto& stored_i = *reinterpret_cast<StoredPack*>(h[i] + first);
      auto& stored_j = *reinterpret_cast<StoredPack*>(h[j] + first);
      const Pack a = stored_i;
      const Pack b = stored_j;
      stored_i = chosen ? b : a;
      stored_j = chosen ? a : b;
    }
  }
}

/// Add a block of each element, column by column, at its index in `blocks`.
///
/// @param slot  of each element's block
/// @param size  number of used lanes
DIFFCLOTH_INLINE void add_blocks(const double (*h)[kBlockLanes],
                                 const std::int32_t (&slot)[kBlockLanes],
                                 int size,
                                 const std::int32_t* place,
                                 double* blocks) {
  double* to[kBlockLanes];
  for (int l = 0; l < size; ++l) to[l] = blocks + 9 * static_cast<std::ptrdiff_t>(place[slot[l]]);
  for (int first = 0; first < size; first += kPack) {
    const int last = first + kPack < size ? first + kPack : size;
    for (int k = 0; k < 8; k += kPack) {
      Pack numbers[kPack];
      for (int i = 0; i < kPack; ++i) {
        numbers[i] = *reinterpret_cast<const StoredPack*>(h[k + i] + first);
      }
      transpose(numbers);
      for (int l = first; l < last; ++l) {
        auto& stored = *reinterpret_cast<StoredPack*>(to[l] + k);
        stored = stored + numbers[l - first];
      }
    }
    for (int l = first; l < last; ++l) to[l][8] += h[8][l];
  }
}

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
