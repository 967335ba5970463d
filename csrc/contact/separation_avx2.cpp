// Distances of four pairs at once, with AVX2. Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

namespace diffcloth::contact {
namespace {
constexpr int kPack = 4;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/separation_lanes_impl.h"

namespace diffcloth::contact {
extern const SquaredDistances kAvx2Distances;
const SquaredDistances kAvx2Distances = find_squared_distances;
}  // namespace diffcloth::contact

#endif
