// Packs of the dense kernels with AVX-512.

#pragma once

#include "linalg/many_floats_avx.h"

namespace diffcloth::linalg {
namespace {

struct Doubles {
  using Real = double;
  static constexpr Real kLeastPivot = 0.0;
  static constexpr Real kLargest = 1.7976931348623157e308;
  __m512d v;
};

inline Doubles load(const double* from) { return {_mm512_loadu_pd(from)}; }
inline void store(double* to, Doubles a) { _mm512_storeu_pd(to, a.v); }
inline Doubles broadcast(double a) { return {_mm512_set1_pd(a)}; }
inline Doubles operator+(Doubles a, Doubles b) { return {_mm512_add_pd(a.v, b.v)}; }
inline Doubles operator*(Doubles a, Doubles b) { return {_mm512_mul_pd(a.v, b.v)}; }

/// c - a b, rounded once.
inline Doubles subtract_product_of(Doubles c, Doubles a, Doubles b) {
  return {_mm512_fnmadd_pd(a.v, b.v, c.v)};
}

/// Sum of the lanes, in the same order at all levels.
inline double total(Doubles a) {
  const __m256d four = _mm256_add_pd(_mm512_maskz_extractf64x4_pd(0xF, a.v, 0),
                                     _mm512_maskz_extractf64x4_pd(0xF, a.v, 1));
  const __m128d two = _mm_add_pd(_mm256_castpd256_pd128(four), _mm256_extractf128_pd(four, 1));
  return _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)));
}

/// to += from for fewer than eight entries.
inline void add_some(const double* from, int count, double* to) {
  const auto lanes = static_cast<__mmask8>((1U << static_cast<unsigned>(count)) - 1U);
  const __m512d sum =
      _mm512_add_pd(_mm512_maskz_loadu_pd(lanes, to), _mm512_maskz_loadu_pd(lanes, from));
  _mm512_mask_storeu_pd(to, lanes, sum);
}

struct Floats {
  using Real = float;
  static constexpr Real kLeastPivot = 0x1p-16F;
  static constexpr Real kLargest = 3.402823466e38F;
  __m512 v;
};

inline Floats load(const float* from) { return {_mm512_loadu_ps(from)}; }
inline void store(float* to, Floats a) { _mm512_storeu_ps(to, a.v); }
inline Floats broadcast(float a) { return {_mm512_set1_ps(a)}; }
inline Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
inline Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline Floats subtract_product_of(Floats c, Floats a, Floats b) {
  return {_mm512_fnmadd_ps(a.v, b.v, c.v)};
}

inline float total(Floats a) {
  const __m256 eight = _mm256_add_ps(_mm512_maskz_extractf32x8_ps(0xFF, a.v, 0),
                                     _mm512_maskz_extractf32x8_ps(0xFF, a.v, 1));
  const __m128 four = _mm_add_ps(_mm256_castps256_ps128(eight), _mm256_extractf128_ps(eight, 1));
  const __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
  return _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps(two, two, 1)));
}

inline void add_some(const float* from, int count, float* to) {
  const auto lanes = static_cast<__mmask16>((1U << static_cast<unsigned>(count)) - 1U);
  const __m512 sum =
      _mm512_add_ps(_mm512_maskz_loadu_ps(lanes, to), _mm512_maskz_loadu_ps(lanes, from));
  _mm512_mask_storeu_ps(to, lanes, sum);
}

inline Doubles load_many(const double* from) { return load(from); }
inline Doubles to_many(double a) { return broadcast(a); }

constexpr int kPacks = 3;  // 24 of 32 registers
constexpr int kWidth = 8;
constexpr int kAcross = 8;

}  // namespace
}  // namespace diffcloth::linalg
