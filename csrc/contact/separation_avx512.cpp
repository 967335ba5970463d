// Distances of eight pairs at once, with AVX-512. Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX512F__

namespace diffcloth::contact {
namespace {
constexpr int kPack = 8;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/separation_lanes_impl.h"

namespace diffcloth::contact {
extern const SquaredDistances kAvx512Distances;
const SquaredDistances kAvx512Distances = find_squared_distances;
}  // namespace diffcloth::contact

#endif
