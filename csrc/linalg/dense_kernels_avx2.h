// Packs of the dense kernels with AVX2 and FMA.

#pragma once

#include "linalg/many_floats_avx.h"

namespace diffcloth::linalg {
namespace {

struct Doubles {
  using Real = double;
  static constexpr Real kLeastPivot = 0.0;
  static constexpr Real kLargest = 1.7976931348623157e308;
  __m256d v[2];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

inline Doubles load(const double* from) {
  return {{_mm256_loadu_pd(from), _mm256_loadu_pd(from + 4)}};
}
inline void store(double* to, Doubles a) {
  _mm256_storeu_pd(to, a.v[0]);
  _mm256_storeu_pd(to + 4, a.v[1]);
}
inline Doubles broadcast(double a) {
  const __m256d lanes = _mm256_set1_pd(a);
  return {{lanes, lanes}};
}
inline Doubles operator+(Doubles a, Doubles b) {
  return {{_mm256_add_pd(a.v[0], b.v[0]), _mm256_add_pd(a.v[1], b.v[1])}};
}
inline Doubles operator*(Doubles a, Doubles b) {
  return {{_mm256_mul_pd(a.v[0], b.v[0]), _mm256_mul_pd(a.v[1], b.v[1])}};
}

/// c - a b, rounded once.
inline Doubles subtract_product_of(Doubles c, Doubles a, Doubles b) {
  return {{_mm256_fnmadd_pd(a.v[0], b.v[0], c.v[0]), _mm256_fnmadd_pd(a.v[1], b.v[1], c.v[1])}};
}

/// Sum of the lanes, in the same order at all levels.
inline double total(Doubles a) {
  const __m256d four = _mm256_add_pd(a.v[0], a.v[1]);
  const __m128d two = _mm_add_pd(_mm256_castpd256_pd128(four), _mm256_extractf128_pd(four, 1));
  return _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)));
}

/// to += from for fewer than eight entries.
inline void add_some(const double* from, int count, double* to) {
  int i = 0;
  if (count >= 4) {
    _mm256_storeu_pd(to, _mm256_add_pd(_mm256_loadu_pd(to), _mm256_loadu_pd(from)));
    i = 4;
  }
  for (; i < count; ++i) to[i] += from[i];
}

struct Floats {
  using Real = float;
  static constexpr Real kLeastPivot = 0x1p-16F;
  static constexpr Real kLargest = 3.402823466e38F;
  __m256 v[2];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

inline Floats load(const float* from) {
  return {{_mm256_loadu_ps(from), _mm256_loadu_ps(from + 8)}};
}
inline void store(float* to, Floats a) {
  _mm256_storeu_ps(to, a.v[0]);
  _mm256_storeu_ps(to + 8, a.v[1]);
}
inline Floats broadcast(float a) {
  const __m256 lanes = _mm256_set1_ps(a);
  return {{lanes, lanes}};
}
inline Floats operator+(Floats a, Floats b) {
  return {{_mm256_add_ps(a.v[0], b.v[0]), _mm256_add_ps(a.v[1], b.v[1])}};
}
inline Floats operator*(Floats a, Floats b) {
  return {{_mm256_mul_ps(a.v[0], b.v[0]), _mm256_mul_ps(a.v[1], b.v[1])}};
}
inline Floats subtract_product_of(Floats c, Floats a, Floats b) {
  return {{_mm256_fnmadd_ps(a.v[0], b.v[0], c.v[0]), _mm256_fnmadd_ps(a.v[1], b.v[1], c.v[1])}};
}

inline float total(Floats a) {
  const __m256 eight = _mm256_add_ps(a.v[0], a.v[1]);
  const __m128 four = _mm_add_ps(_mm256_castps256_ps128(eight), _mm256_extractf128_ps(eight, 1));
  const __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
  return _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps(two, two, 1)));
}

/// to += from for fewer than sixteen entries.
inline void add_some(const float* from, int count, float* to) {
  int i = 0;
  if (count >= 8) {
    _mm256_storeu_ps(to, _mm256_add_ps(_mm256_loadu_ps(to), _mm256_loadu_ps(from)));
    i = 8;
  }
  if (count >= i + 4) {
    _mm_storeu_ps(to + i, _mm_add_ps(_mm_loadu_ps(to + i), _mm_loadu_ps(from + i)));
    i += 4;
  }
  for (; i < count; ++i) to[i] += from[i];
}

inline Doubles load_many(const double* from) { return load(from); }
inline Doubles to_many(double a) { return broadcast(a); }

constexpr int kPacks = 1;  // 8 of 16 registers
constexpr int kWidth = 4;
constexpr int kAcross = 4;

}  // namespace
}  // namespace diffcloth::linalg
