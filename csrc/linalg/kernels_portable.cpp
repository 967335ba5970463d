// The dense kernels in what GCC and Clang make of vectors of two doubles, which every 64-bit
// processor has.

namespace diffcloth::linalg {
namespace {

using Two = double __attribute__((vector_size(16)));
using UnalignedTwo = double __attribute__((vector_size(16), aligned(8), may_alias));

struct Pack {
  Two v[4];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

inline Pack zero() { return {}; }
inline Pack load(const double* from) {
  const auto* const lanes = reinterpret_cast<const UnalignedTwo*>(from);
  return {{lanes[0], lanes[1], lanes[2], lanes[3]}};
}
inline void store(double* to, Pack a) {
  auto* const lanes = reinterpret_cast<UnalignedTwo*>(to);
  for (int i = 0; i < 4; ++i) lanes[i] = a.v[i];
}
inline Pack broadcast(double a) {
  const Two lanes = {a, a};
  return {{lanes, lanes, lanes, lanes}};
}
inline Pack operator+(Pack a, Pack b) {
  for (int i = 0; i < 4; ++i) a.v[i] += b.v[i];
  return a;
}
inline Pack operator*(Pack a, Pack b) {
  for (int i = 0; i < 4; ++i) a.v[i] *= b.v[i];
  return a;
}

/// c - a b: rounded once where the processor can, as at the other levels, else twice.
inline double subtract_product_of(double c, double a, double b) {
#ifdef __FP_FAST_FMA
  return __builtin_fma(-a, b, c);
#else
  return c - a * b;
#endif
}
inline Pack subtract_product_of(Pack c, Pack a, Pack b) {
#ifdef __FP_FAST_FMA
  for (int i = 0; i < 4; ++i) {
    c.v[i][0] = __builtin_fma(-a.v[i][0], b.v[i][0], c.v[i][0]);
    c.v[i][1] = __builtin_fma(-a.v[i][1], b.v[i][1], c.v[i][1]);
  }
#else
  for (int i = 0; i < 4; ++i) c.v[i] -= a.v[i] * b.v[i];
#endif
  return c;
}

/// The sum of the lanes, in the one order that all levels have.
inline double total(Pack a) {
  const Two two = (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
  return two[0] + two[1];
}

/// to += from for fewer than eight entries.
inline void add_some(const double* from, int count, double* to) {
  for (int i = 0; i < count; ++i) to[i] += from[i];
}

constexpr int kPacks = 1;  // 8 of 16 registers
constexpr int kWidth = 2;

}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/dense_kernels_impl.h"

namespace diffcloth::linalg {
extern const DenseKernels kPortableKernels;
const DenseKernels kPortableKernels = kKernels;
}  // namespace diffcloth::linalg
