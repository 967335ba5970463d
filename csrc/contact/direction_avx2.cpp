// Derivatives along directions with AVX2.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

namespace diffcloth::contact {
namespace {
constexpr int kPack = 4;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/direction_lanes_impl.h"

namespace diffcloth::contact {
extern const DirectionLevel kAvx2Directions;
const DirectionLevel kAvx2Directions = kKernels;
}  // namespace diffcloth::contact

#endif
