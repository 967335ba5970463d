// Packs of the dense kernels as vectors of two doubles, which GCC and Clang compile for every 64-bit
// processor.

#pragma once

namespace diffcloth::linalg {
namespace {

using Two = double __attribute__((vector_size(16)));
using UnalignedTwo = double __attribute__((vector_size(16), aligned(8), may_alias));
using FourFloats = float __attribute__((vector_size(16)));
using UnalignedFourFloats = float __attribute__((vector_size(16), aligned(4), may_alias));

struct Doubles {
  using Real = double;
  static constexpr Real kLeastPivot = 0.0;
  static constexpr Real kLargest = 1.7976931348623157e308;
  Two v[4];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

struct Floats {
  using Real = float;
  static constexpr Real kLeastPivot = 0x1p-16F;
  static constexpr Real kLargest = 3.402823466e38F;
  FourFloats v[4];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

/// One float of each of kMaxVectors vectors.
struct ManyFloats {
  using Real = float;
  FourFloats v[2];  // NOLINT(modernize-avoid-c-arrays): see dense_kernels_impl.h
};

inline Doubles load(const double* from) {
  const auto* const lanes = reinterpret_cast<const UnalignedTwo*>(from);
  return {{lanes[0], lanes[1], lanes[2], lanes[3]}};
}
inline Floats load(const float* from) {
  const auto* const lanes = reinterpret_cast<const UnalignedFourFloats*>(from);
  return {{lanes[0], lanes[1], lanes[2], lanes[3]}};
}
inline void store(double* to, Doubles a) {
  auto* const lanes = reinterpret_cast<UnalignedTwo*>(to);
  for (int i = 0; i < 4; ++i) lanes[i] = a.v[i];
}
inline void store(float* to, Floats a) {
  auto* const lanes = reinterpret_cast<UnalignedFourFloats*>(to);
  for (int i = 0; i < 4; ++i) lanes[i] = a.v[i];
}
inline Doubles broadcast(double a) {
  const Two lanes = {a, a};
  return {{lanes, lanes, lanes, lanes}};
}
inline Floats broadcast(float a) {
  const FourFloats lanes = {a, a, a, a};
  return {{lanes, lanes, lanes, lanes}};
}
inline ManyFloats load_many(const float* from) {
  const auto* const lanes = reinterpret_cast<const UnalignedFourFloats*>(from);
  return {{lanes[0], lanes[1]}};
}
inline void store(float* to, ManyFloats a) {
  auto* const lanes = reinterpret_cast<UnalignedFourFloats*>(to);
  for (int i = 0; i < 2; ++i) lanes[i] = a.v[i];
}
inline ManyFloats to_many(float a) {
  const FourFloats lanes = {a, a, a, a};
  return {{lanes, lanes}};
}
inline Doubles load_many(const double* from) { return load(from); }
inline Doubles to_many(double a) { return broadcast(a); }

template <class Pack>
constexpr int kParts = sizeof(Pack) / 16;

template <class Pack>
inline Pack operator+(Pack a, Pack b) {
  for (int i = 0; i < kParts<Pack>; ++i) a.v[i] += b.v[i];
  return a;
}
template <class Pack>
inline Pack operator*(Pack a, Pack b) {
  for (int i = 0; i < kParts<Pack>; ++i) a.v[i] *= b.v[i];
  return a;
}

/// c - a b: rounded once if the processor has fused multiply-add, as at the other levels, else twice.
inline double subtract_product_of(double c, double a, double b) {
#ifdef __FP_FAST_FMA
  return __builtin_fma(-a, b, c);
#else
  return c - a * b;
#endif
}
inline float subtract_product_of(float c, float a, float b) {
#ifdef __FP_FAST_FMAF
  return __builtin_fmaf(-a, b, c);
#else
  return c - a * b;
#endif
}
template <class Pack>
inline Pack subtract_product_of(Pack c, Pack a, Pack b) {
#ifdef __FP_FAST_FMA
  for (int i = 0; i < kParts<Pack>; ++i) {
    for (unsigned lane = 0; lane < 16 / sizeof(typename Pack::Real); ++lane) {
      c.v[i][lane] = subtract_product_of(c.v[i][lane], a.v[i][lane], b.v[i][lane]);
    }
  }
#else
  for (int i = 0; i < kParts<Pack>; ++i) c.v[i] -= a.v[i] * b.v[i];
#endif
  return c;
}

/// Sum of the lanes, in the same order at all levels.
inline double total(Doubles a) {
  const Two two = (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
  return two[0] + two[1];
}
inline float total(Floats a) {
  const FourFloats four = (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
  return (four[0] + four[2]) + (four[1] + four[3]);
}

/// to += from for less than a pack.
template <class Real>
inline void add_some(const Real* from, int count, Real* to) {
  for (int i = 0; i < count; ++i) to[i] += from[i];
}

constexpr int kPacks = 1;  // 8 of 16 registers
constexpr int kWidth = 2;
constexpr int kAcross = 4;

}  // namespace
}  // namespace diffcloth::linalg
