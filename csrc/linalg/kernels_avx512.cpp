// The dense kernels with AVX-512. Only CMakeLists.txt's flags for this file allow the instructions.
#ifdef __AVX512F__

#include <immintrin.h>

namespace diffcloth::linalg {
namespace {

struct Pack {
  __m512d v;
};

inline Pack zero() { return {_mm512_setzero_pd()}; }
inline Pack load(const double* from) { return {_mm512_loadu_pd(from)}; }
inline void store(double* to, Pack a) { _mm512_storeu_pd(to, a.v); }
inline Pack broadcast(double a) { return {_mm512_set1_pd(a)}; }
inline Pack operator+(Pack a, Pack b) { return {_mm512_add_pd(a.v, b.v)}; }
inline Pack operator*(Pack a, Pack b) { return {_mm512_mul_pd(a.v, b.v)}; }

/// c - a b, rounded once.
inline Pack subtract_product_of(Pack c, Pack a, Pack b) {
  return {_mm512_fnmadd_pd(a.v, b.v, c.v)};
}
inline double subtract_product_of(double c, double a, double b) { return __builtin_fma(-a, b, c); }

/// The sum of the lanes, in the one order that all levels have.
inline double total(Pack a) {
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

constexpr int kPacks = 3;  // 24 of 32 registers
constexpr int kWidth = 8;

}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/dense_kernels_impl.h"

namespace diffcloth::linalg {
extern const DenseKernels kAvx512Kernels;
const DenseKernels kAvx512Kernels = kKernels;
}  // namespace diffcloth::linalg

#endif
