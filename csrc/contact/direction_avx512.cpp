// Derivatives along directions with AVX-512.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX512F__

namespace diffcloth::contact {
namespace {
constexpr int kPack = 8;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/direction_lanes_impl.h"

namespace diffcloth::contact {
extern const DirectionLevel kAvx512Directions;
const DirectionLevel kAvx512Directions = kKernels;
}  // namespace diffcloth::contact

#endif
