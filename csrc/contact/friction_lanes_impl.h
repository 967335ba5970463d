// The arithmetic of FrictionKernels, written once over packs of `kPack` doubles: a pack holds one number
// of each of kPack entries. Everything is in an anonymous namespace, for the reason given in
// linalg/dense_kernels_impl.h.

#pragma once

#include "contact/friction_lanes.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::contact {
namespace {

using Pack = double __attribute__((vector_size(8 * kPack)));
using Stored = double __attribute__((vector_size(8 * kPack), aligned(8), may_alias));
using Mask = long long __attribute__((vector_size(8 * kPack)));

DIFFCLOTH_INLINE Pack load(const double* from) { return *reinterpret_cast<const Stored*>(from); }

struct Vectors {
  Pack v[3];
};

DIFFCLOTH_INLINE Vectors operator+(const Vectors& a, const Vectors& b) {
  return {{a.v[0] + b.v[0], a.v[1] + b.v[1], a.v[2] + b.v[2]}};
}
DIFFCLOTH_INLINE Vectors operator-(const Vectors& a, const Vectors& b) {
  return {{a.v[0] - b.v[0], a.v[1] - b.v[1], a.v[2] - b.v[2]}};
}
DIFFCLOTH_INLINE Vectors operator*(const Pack& a, const Vectors& b) {
  return {{a * b.v[0], a * b.v[1], a * b.v[2]}};
}
DIFFCLOTH_INLINE Pack dot(const Vectors& a, const Vectors& b) {
  return a.v[0] * b.v[0] + a.v[1] * b.v[1] + a.v[2] * b.v[2];
}
DIFFCLOTH_INLINE Vectors cross(const Vectors& a, const Vectors& b) {
  return {{a.v[1] * b.v[2] - a.v[2] * b.v[1], a.v[2] * b.v[0] - a.v[0] * b.v[2],
           a.v[0] * b.v[1] - a.v[1] * b.v[0]}};
}
DIFFCLOTH_INLINE Vectors tangential(const Vectors& u, const Vectors& n) {
  return u - dot(n, u) * n;
}

DIFFCLOTH_INLINE Pack root(const Pack& a) {
  Pack result;
  for (int l = 0; l < kPack; ++l) result[l] = __builtin_sqrt(a[l]);
  return result;
}

/// Numbers of the entries from `first` on.
DIFFCLOTH_INLINE Vectors vectors(const double (&values)[3][kFrictionLanes], int first) {
  return {{load(values[0] + first), load(values[1] + first), load(values[2] + first)}};
}

/// Rows of an array.
DIFFCLOTH_INLINE Vectors rows(const double* values,
                              const std::int32_t* index,
                              std::ptrdiff_t stride) {
  Vectors result;
  for (int l = 0; l < kPack; ++l) {
    const double* const from = values + stride * index[l];
    for (int k = 0; k < 3; ++k) result.v[k][l] = from[k];
  }
  return result;
}

/// Store vectors of the first `size` entries.
DIFFCLOTH_INLINE void put(
    const Vectors& values, const std::int32_t* entry, int size, std::ptrdiff_t stride, double* to) {
  for (int l = 0; l < size; ++l) {
    for (int k = 0; k < 3; ++k) to[stride * entry[l] + k] = values.v[k][l];
  }
}

/// See common/friction_law.h.
struct Laws {
  Pack value[5];
};

DIFFCLOTH_INLINE Laws friction_laws(const Pack& y, double e) {
  constexpr double kLeast = 2.2250738585072014e-308;  // the smallest normal number
  const Mask slides = ~(y < Pack{} + e);
  const Pack r = y / e;
  const Pack y_e_sq = y * e * e;
  const Pack f2 = -1.0 / (slides ? y * y * y : y_e_sq);
  Laws law;
  law.value[0] = slides ? y : y * r * (1.0 - r / 3.0) + e / 3.0;
  law.value[1] = (slides ? Pack{} + 1.0 : 2.0 - r) / (slides ? y : Pack{} + e);
  law.value[2] = (slides | (y_e_sq > kLeast)) ? f2 : Pack{};
  law.value[3] = slides ? Pack{} : -2.0 * (1.0 - r) / (e * e);
  law.value[4] = slides ? Pack{} : 1.0 / 3.0 - r * r * (1.0 - 2.0 * r / 3.0);
  return law;
}

/// Slips of kPack entries of a batch, of which `size` are stored.
DIFFCLOTH_INLINE void find_slips_of(const FrictionBatch& batch,
                                    int first,
                                    int size,
                                    const double* x,
                                    const double* delta,
                                    double e,
                                    double* slips) {
  Vectors s = {};
  for (int i = 0; i < batch.points; ++i) {
    s = s + load(batch.c[i] + first) * rows(delta, batch.point[i] + first, 3);
  }
  const auto edge = [&](const double* of, int k) {
    return rows(of, batch.edge[2 * k + 1] + first, 3) - rows(of, batch.edge[2 * k] + first, 3);
  };
  const Vectors e1 = edge(x, 0);
  const Vectors e2 = edge(x, 1);
  const Vectors change_1 = edge(delta, 0);
  const Vectors change_2 = edge(delta, 1);
  const Vectors a = vectors(batch.a, first);
  s = s - (a.v[0] * change_1 + a.v[1] * change_2 +
           a.v[2] * (cross(change_1, e2) + cross(vectors(batch.e1_start, first), change_2)));
  const Vectors n = vectors(batch.n, first);
  const Vectors w = vectors(batch.w_start, first) + tangential(s, n);
  const Laws law = friction_laws(root(dot(w, w)), e);

  const std::int32_t* const entry = batch.entry + first;
  const auto put_at = [&](const Vectors& values, std::ptrdiff_t place) {
    put(values, entry, size, SlipLayout::kSize, slips + place);
  };
  put_at(e1, SlipLayout::kFrame);
  put_at(e2, SlipLayout::kFrame + 3);
  put_at(cross(e1, e2), SlipLayout::kFrame + 6);
  put_at(vectors(batch.s_start, first) + s, SlipLayout::kS);
  put_at(w, SlipLayout::kW);
  for (int l = 0; l < size; ++l) {
    double* const to = slips + SlipLayout::kSize * entry[l] + SlipLayout::kLaw;
    for (int k = 0; k < 5; ++k) to[k] = law.value[k][l];
  }
}

DIFFCLOTH_INLINE void find_changes_of(const FrictionBatch& batch,
                                      int first,
                                      int size,
                                      const double* z,
                                      const double* slips,
                                      double* changes) {
  const Vectors origin = rows(z, batch.point[0] + first, 3);
  Vectors change = {};
  for (int i = 1; i < batch.points; ++i) {
    change = change + load(batch.c[i] + first) * (rows(z, batch.point[i] + first, 3) - origin);
  }
  const auto edge = [&](int k) {
    return rows(z, batch.edge[2 * k + 1] + first, 3) - rows(z, batch.edge[2 * k] + first, 3);
  };
  const Vectors change_1 = edge(0);
  const Vectors change_2 = edge(1);
  const std::int32_t* const entry = batch.entry + first;
  const Vectors e1 = rows(slips + SlipLayout::kFrame, entry, SlipLayout::kSize);
  const Vectors e2 = rows(slips + SlipLayout::kFrame + 3, entry, SlipLayout::kSize);
  const Vectors a = vectors(batch.a, first);
  change = change - a.v[0] * change_1 - a.v[1] * change_2 -
           a.v[2] * (cross(change_1, e2) + cross(e1, change_2));
  put(tangential(change, vectors(batch.n, first)), entry, size, 3, changes);
}

/// Call of(batch, first, size) for packs of entries.
template <class Call>
DIFFCLOTH_INLINE void for_packs(const FrictionBatch* batches, std::size_t count, Call of) {
  for (const FrictionBatch* batch = batches; batch != batches + count; ++batch) {
    for (int first = 0; first < batch->size; first += kPack) {
      const int left = batch->size - first;
      of(*batch, first, left < kPack ? left : kPack);
    }
  }
}

void find_slips(const FrictionBatch* batches,
                std::size_t count,
                const double* x,
                const double* delta,
                double e,
                double* slips) {
  for_packs(batches, count, [&](const FrictionBatch& batch, int first, int size) {
    find_slips_of(batch, first, size, x, delta, e, slips);
  });
}

void find_changes(const FrictionBatch* batches,
                  std::size_t count,
                  const double* z,
                  const double* slips,
                  double* changes) {
  for_packs(batches, count, [&](const FrictionBatch& batch, int first, int size) {
    find_changes_of(batch, first, size, z, slips, changes);
  });
}

constexpr FrictionKernels kKernels{.find_slips = find_slips, .find_changes = find_changes};

}  // namespace
}  // namespace diffcloth::contact

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
