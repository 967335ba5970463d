// Definitions common to the kernels for AVX2 and AVX-512: ManyFloats, which is half a register of
// AVX-512, and products of single numbers. Everything is in an anonymous namespace, for the reason given
// in dense_kernels_impl.h.

#pragma once

#include <immintrin.h>

namespace diffcloth::linalg {
namespace {

/// One float of each of kMaxVectors vectors.
struct ManyFloats {
  using Real = float;
  __m256 v;
};

inline ManyFloats load_many(const float* from) { return {_mm256_loadu_ps(from)}; }
inline void store(float* to, ManyFloats a) { _mm256_storeu_ps(to, a.v); }
inline ManyFloats to_many(float a) { return {_mm256_set1_ps(a)}; }
inline ManyFloats operator+(ManyFloats a, ManyFloats b) { return {_mm256_add_ps(a.v, b.v)}; }
inline ManyFloats operator*(ManyFloats a, ManyFloats b) { return {_mm256_mul_ps(a.v, b.v)}; }
inline ManyFloats subtract_product_of(ManyFloats c, ManyFloats a, ManyFloats b) {
  return {_mm256_fnmadd_ps(a.v, b.v, c.v)};
}

inline double subtract_product_of(double c, double a, double b) { return __builtin_fma(-a, b, c); }
inline float subtract_product_of(float c, float a, float b) { return __builtin_fmaf(-a, b, c); }

}  // namespace
}  // namespace diffcloth::linalg
