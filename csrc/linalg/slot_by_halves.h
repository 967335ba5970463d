// The search for a slot where no instruction compares a whole column at once. In an anonymous namespace, for the
// reason given in linalg/dense_kernels_impl.h.

#pragma once

#include <cstddef>
#include <cstdint>

namespace diffcloth::linalg {

namespace {

/// See BlockPattern::slot(). Columns differ in length, and a loop that ends somewhere else each time costs more
/// than steps that do nothing.
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

}  // namespace
}  // namespace diffcloth::linalg
