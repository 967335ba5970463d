// The search for a slot of a pattern. In an anonymous namespace, for the reason given in
// linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>
#include <cstdint>

#ifdef __AVX512F__
#include <immintrin.h>
#endif

namespace diffcloth::linalg {

namespace {

#ifdef __AVX512F__

/// See BlockPattern::slot(). AVX-512 compares the rows of a column at once.
inline std::ptrdiff_t slot_of(const std::int32_t* start,
                              const std::int32_t* rows,
                              std::int32_t i,
                              std::int32_t j) {
  constexpr std::int32_t kLanes = 16;
  const std::int32_t* first = rows + start[j];
  std::int32_t count = start[j + 1] - start[j];
  const __m512i wanted = _mm512_set1_epi32(i);
  // Most columns fit in two registers: the loop runs only for longer ones.
  for (; __builtin_expect(count > 2 * kLanes, 0) && first[2 * kLanes - 1] < i;
       count -= 2 * kLanes) {
    first += 2 * kLanes;
  }
  const std::uint64_t exist = count >= 2 * kLanes ? 0xFFFFFFFFU : (std::uint64_t{1} << count) - 1U;
  const auto low = static_cast<__mmask16>(exist);
  const auto high = static_cast<__mmask16>(exist >> kLanes);
  // Masked-out lanes are not read.
  const auto found_among = [&](__mmask16 lanes, const std::int32_t* from) -> std::uint32_t {
    return _mm512_mask_cmpeq_epi32_mask(lanes, _mm512_maskz_loadu_epi32(lanes, from), wanted);
  };
  const std::uint32_t found = found_among(low, first) | found_among(high, first + kLanes) << kLanes;
  return first - rows + __builtin_ctz(found);
}

#else

/// See BlockPattern::slot(). Columns differ in length, and a loop with an unpredictable end costs more
/// than steps without effect.
inline __attribute__((always_inline)) std::ptrdiff_t slot_of(const std::int32_t* start,
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

#endif

}  // namespace
}  // namespace diffcloth::linalg
