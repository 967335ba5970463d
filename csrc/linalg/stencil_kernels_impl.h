// Kernel of AddStencil, written once over vectors of `kRows` doubles. Everything here is in an anonymous
// namespace, for the reason given in linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>

#include "linalg/slot_search.h"
#include "linalg/stencil_kernels.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::linalg {

namespace {

/// Twelve and sixteen rows are three and four vectors of four; vectors of eight are no faster.
constexpr int kRows = kPack < 4 ? kPack : 4;

using Pack = double __attribute__((vector_size(8 * kRows)));
using Stored = double __attribute__((vector_size(8 * kRows), aligned(8), may_alias));

DIFFCLOTH_INLINE Pack load(const double* from) { return *reinterpret_cast<const Stored*>(from); }
DIFFCLOTH_INLINE void store(double* to, const Pack& from) { *reinterpret_cast<Stored*>(to) = from; }

/// Numbers 0 1 2 0 and 1 2 0 1 of one point, and 0 0 0 1 and 1 1 2 2 of another: their products are the
/// first eight entries of the block, column by column.
using Four = double __attribute__((vector_size(32)));
using StoredFour = double __attribute__((vector_size(32), aligned(8), may_alias));
struct Eight {
  Four v[2];
};

/// Load three numbers that are followed, or preceded, by another one, and arrange them in the order of
/// rows or of columns.
template <bool kPreceded>
DIFFCLOTH_INLINE void spread(const double* from, bool rows, Eight& to) {
  const StoredFour& v = *reinterpret_cast<const StoredFour*>(kPreceded ? from - 1 : from);
  constexpr int kFirst = kPreceded ? 1 : 0;
  if (rows) {
    to.v[0] = Four{v[kFirst], v[kFirst + 1], v[kFirst + 2], v[kFirst]};
    to.v[1] = Four{v[kFirst + 1], v[kFirst + 2], v[kFirst], v[kFirst + 1]};
  } else {
    to.v[0] = Four{v[kFirst], v[kFirst], v[kFirst], v[kFirst + 1]};
    to.v[1] = Four{v[kFirst + 1], v[kFirst + 1], v[kFirst + 2], v[kFirst + 2]};
  }
}

/// Kernel for kPoints points, with vectors of kSize numbers.
template <int kPoints, int kSize>
DIFFCLOTH_INLINE void add(const StencilTerms& of,
                          const std::int32_t* row,
                          const std::int32_t* start,
                          const std::int32_t* rows,
                          double* blocks) {
  // The matrix exceeds the first-level cache: prefetch its blocks early.
  double* to_block[kPoints][kPoints] = {};
#pragma GCC unroll 5
  for (int p = 0; p < kPoints; ++p) {
#pragma GCC unroll 5
    for (int q = 0; q <= p; ++q) {
      if (row[p] < 0 || row[q] < 0) continue;
      const std::int32_t i = row[p] > row[q] ? row[p] : row[q];
      const std::int32_t j = row[p] > row[q] ? row[q] : row[p];
      // The diagonal block is the first of its column.
      double* const block = blocks + 9 * (p == q ? start[j] : slot_of(start, rows, i, j));
      to_block[p][q] = block;
      __builtin_prefetch(block);
      __builtin_prefetch(block + 8);
    }
  }
  double made[3][kSize];
  const double* right[3] = {of.right[0], of.right[1], of.right[2]};
  if (of.core != nullptr) {
    for (int k = 0; k < 3; ++k) {
      for (int l = 0; l < kSize / kRows; ++l) {
        Pack sum = of.core[k] * load(of.left[0] + kRows * l);
        for (int m = 1; m < 3; ++m) sum += of.core[3 * m + k] * load(of.left[m] + kRows * l);
        store(made[k] + kRows * l, sum);
      }
      right[k] = made[k];
    }
  }
  Eight as_row[kPoints][3];
  Eight as_column[kPoints][3];
#pragma GCC unroll 3
  for (int k = 0; k < 3; ++k) {
    if (k >= of.terms) break;
#pragma GCC unroll 4
    for (int p = 0; p < kPoints - 1; ++p) {
      spread<false>(of.left[k] + 3 * p, true, as_row[p][k]);
      spread<false>(right[k] + 3 * p, false, as_column[p][k]);
    }
    spread<true>(of.left[k] + 3 * (kPoints - 1), true, as_row[kPoints - 1][k]);
    spread<true>(right[k] + 3 * (kPoints - 1), false, as_column[kPoints - 1][k]);
  }
#pragma GCC unroll 5
  for (int p = 0; p < kPoints; ++p) {
#pragma GCC unroll 5
    for (int q = 0; q <= p; ++q) {
      if (row[p] < 0 || row[q] < 0) continue;
      // The order of the two rows is unpredictable, hence no branches.
      const bool is_lower = row[p] >= row[q];
      const int r = is_lower ? p : q;
      const int c = is_lower ? q : p;
      Four sum[2] = {};
      double last = 0.0;
      for (int k = 0; k < of.terms; ++k) {
        for (int l = 0; l < 2; ++l) sum[l] += as_column[c][k].v[l] * as_row[r][k].v[l];
        last += right[k][3 * c + 2] * of.left[k][3 * r + 2];
      }
      if (of.rest != nullptr) {
        const double* const from = of.rest + 36 * c + 3 * r;
        sum[0] += Four{from[0], from[1], from[2], from[12]};
        sum[1] += Four{from[13], from[14], from[24], from[25]};
        last += from[26];
      }
      double* const to = to_block[p][q];
      for (int l = 0; l < 2; ++l) {
        auto& stored = *reinterpret_cast<StoredFour*>(to + 4 * l);
        stored = stored + sum[l];
      }
      to[8] += last;
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

constexpr AddStencil kKernels = add_stencil;

}  // namespace
}  // namespace diffcloth::linalg

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
