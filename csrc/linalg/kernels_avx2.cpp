// The dense kernels with AVX2 and FMA. Only CMakeLists.txt's flags for this file allow them.
#ifdef __AVX2__

#include <immintrin.h>

namespace diffcloth::linalg {
namespace {

struct Pack {
  __m256d v[2];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

inline Pack zero() { return {{_mm256_setzero_pd(), _mm256_setzero_pd()}}; }
inline Pack load(const double* from) {
  return {{_mm256_loadu_pd(from), _mm256_loadu_pd(from + 4)}};
}
inline void store(double* to, Pack a) {
  _mm256_storeu_pd(to, a.v[0]);
  _mm256_storeu_pd(to + 4, a.v[1]);
}
inline Pack broadcast(double a) {
  const __m256d lanes = _mm256_set1_pd(a);
  return {{lanes, lanes}};
}
inline Pack operator+(Pack a, Pack b) {
  return {{_mm256_add_pd(a.v[0], b.v[0]), _mm256_add_pd(a.v[1], b.v[1])}};
}
inline Pack operator*(Pack a, Pack b) {
  return {{_mm256_mul_pd(a.v[0], b.v[0]), _mm256_mul_pd(a.v[1], b.v[1])}};
}

/// c - a b, rounded once.
inline Pack subtract_product_of(Pack c, Pack a, Pack b) {
  return {{_mm256_fnmadd_pd(a.v[0], b.v[0], c.v[0]), _mm256_fnmadd_pd(a.v[1], b.v[1], c.v[1])}};
}
inline double subtract_product_of(double c, double a, double b) { return __builtin_fma(-a, b, c); }

/// The sum of the lanes, in the one order that all levels have.
inline double total(Pack a) {
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

constexpr int kPacks = 1;  // 8 of 16 registers
constexpr int kWidth = 4;

}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/dense_kernels_impl.h"

namespace diffcloth::linalg {
extern const DenseKernels kAvx2Kernels;
const DenseKernels kAvx2Kernels = kKernels;
}  // namespace diffcloth::linalg

#endif
