// The arithmetic of AddStencil, written once over vectors of `kPack` doubles, which the file that includes this
// one defines. Everything here is in an anonymous namespace, for the reason given in
// linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>

#include "linalg/stencil_kernels.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::linalg {

namespace {

using Pack = double __attribute__((vector_size(8 * kPack)));
using Stored = double __attribute__((vector_size(8 * kPack), aligned(8), may_alias));

DIFFCLOTH_INLINE Pack load(const double* from) { return *reinterpret_cast<const Stored*>(from); }
DIFFCLOTH_INLINE void store(double* to, const Pack& from) { *reinterpret_cast<Stored*>(to) = from; }

/// See BlockPattern::slot(). Columns differ in length, and a loop that ends somewhere else each time costs more
/// than steps that do nothing.
DIFFCLOTH_INLINE std::ptrdiff_t slot_of(const std::int32_t* start,
                                        const std::int32_t* rows,
                                        std::int32_t i,
                                        std::int32_t j) {
  constexpr int kSteps = 5;  // enough for 31 blocks
  const std::int32_t* first = rows + start[j];
  std::int32_t count = start[j + 1] - start[j];
  while (__builtin_expect(count >= (1 << kSteps), 0)) {
    const std::int32_t half = (count + 1) / 2;
    first += half * static_cast<std::int32_t>(first[half - 1] < i);
    count -= half;
  }
  for (int step = 0; step < kSteps; ++step) {
    const std::int32_t half = (count + 1) / 2;
    first += half * static_cast<std::int32_t>(first[half - static_cast<int>(half > 0)] < i);
    count -= half;
  }
  return first - rows;
}

/// kSize numbers a vector, of kPoints points.
template <int kPoints, int kSize>
DIFFCLOTH_INLINE void add(const StencilTerms& of,
                          const std::int32_t* row,
                          const std::int32_t* start,
                          const std::int32_t* rows,
                          double* blocks) {
  // A matrix is larger than the nearest cache: where its blocks are is told early.
  double* to_block[kPoints][kPoints];
  for (int p = 0; p < kPoints; ++p) {
    for (int q = 0; q <= p; ++q) {
      if (row[p] < 0 || row[q] < 0) continue;
      const std::int32_t i = row[p] > row[q] ? row[p] : row[q];
      const std::int32_t j = row[p] > row[q] ? row[q] : row[p];
      double* const block = blocks + 9 * slot_of(start, rows, i, j);
      to_block[p][q] = block;
      __builtin_prefetch(block);
      __builtin_prefetch(block + 8);
    }
  }
  constexpr int kPacks = kSize / kPack;
  double made[3][kSize];
  const double* right[3] = {of.right[0], of.right[1], of.right[2]};
  if (of.core != nullptr) {
    for (int k = 0; k < 3; ++k) {
      for (int l = 0; l < kPacks; ++l) {
        Pack sum = of.core[k] * load(of.left[0] + kPack * l);
        for (int m = 1; m < 3; ++m) sum += of.core[3 * m + k] * load(of.left[m] + kPack * l);
        store(made[k] + kPack * l, sum);
      }
      right[k] = made[k];
    }
  }
  double h[3 * kPoints][kSize];  // column by column
  for (int q = 0; q < kPoints; ++q) {
    if (row[q] < 0) continue;
    for (int b = 0; b < 3; ++b) {
      double* const column = h[3 * q + b];
      Pack sum[kPacks] = {};
      for (int k = 0; k < of.terms; ++k) {
        const double by = right[k][3 * q + b];
        for (int l = 0; l < kPacks; ++l) sum[l] += by * load(of.left[k] + kPack * l);
      }
      if (of.rest != nullptr) {
        for (int l = 0; l < kPacks; ++l) {
          sum[l] += load(of.rest + 12 * (3 * q + b) + kPack * l);
        }
      }
      for (int l = 0; l < kPacks; ++l) store(column + kPack * l, sum[l]);
    }
  }
  for (int p = 0; p < kPoints; ++p) {
    for (int q = 0; q <= p; ++q) {
      if (row[p] < 0 || row[q] < 0) continue;
      // Which of both is the row is as good as random, so that there are no branches.
      const bool is_lower = row[p] >= row[q];
      const int r = is_lower ? p : q;
      const int c = is_lower ? q : p;
      const double* const from = h[3 * c] + 3 * r;
      double* const to = to_block[p][q];
      for (int b = 0; b < 3; ++b) {
        for (int a = 0; a < 3; ++a) to[3 * b + a] += from[kSize * b + a];
      }
      if (of.along != 0.0) {
        const double along = of.along * of.c[p] * of.c[q];
        for (int a = 0; a < 3; ++a) to[4 * a] += along;
      }
      if (of.turn != nullptr) {
        const double f = of.sign[0][r] * of.sign[1][c] - of.sign[1][r] * of.sign[0][c];
        const double t[3] = {f * of.turn[0], f * of.turn[1], f * of.turn[2]};
        to[1] += t[2];
        to[2] -= t[1];
        to[3] -= t[2];
        to[5] += t[0];
        to[6] += t[1];
        to[7] -= t[0];
      }
    }
  }
}

void add_stencil(const StencilTerms& of,
                 const std::int32_t* row,
                 const std::int32_t* start,
                 const std::int32_t* rows,
                 double* blocks) {
  if (of.count == 4) {
    add<4, 12>(of, row, start, rows, blocks);
  } else {
    add<5, 16>(of, row, start, rows, blocks);
  }
}

}  // namespace
}  // namespace diffcloth::linalg

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
