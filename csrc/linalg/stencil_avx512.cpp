// Matrices of stencils with AVX-512, which compares the rows of a column at once; vectors of eight are no faster.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX512F__

#include <cstddef>
#include <cstdint>

#include <immintrin.h>

namespace diffcloth::linalg {
namespace {

constexpr int kPack = 4;

inline std::ptrdiff_t slot_of(const std::int32_t* start,
                              const std::int32_t* rows,
                              std::int32_t i,
                              std::int32_t j) {
  constexpr std::int32_t kLanes = 16;
  const std::int32_t* first = rows + start[j];
  std::int32_t count = start[j + 1] - start[j];
  const __m512i wanted = _mm512_set1_epi32(i);
  // Most columns are two registers long at most: no branch but for longer ones.
  for (; __builtin_expect(count > 2 * kLanes, 0) && first[2 * kLanes - 1] < i;
       count -= 2 * kLanes) {
    first += 2 * kLanes;
  }
  const std::uint64_t exist = count >= 2 * kLanes ? 0xFFFFFFFFU : (std::uint64_t{1} << count) - 1U;
  const auto low = static_cast<__mmask16>(exist);
  const auto high = static_cast<__mmask16>(exist >> kLanes);
  // What a mask leaves out is not read.
  const auto found_among = [&](__mmask16 lanes, const std::int32_t* from) -> std::uint32_t {
    return _mm512_mask_cmpeq_epi32_mask(lanes, _mm512_maskz_loadu_epi32(lanes, from), wanted);
  };
  const std::uint32_t found = found_among(low, first) | found_among(high, first + kLanes) << kLanes;
  return first - rows + __builtin_ctz(found);
}

}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/stencil_kernels_impl.h"

namespace diffcloth::linalg {
extern const AddStencil kAvx512Stencil;
const AddStencil kAvx512Stencil = add_stencil;
}  // namespace diffcloth::linalg

#endif
