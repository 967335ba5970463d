// Derivatives along directions in vectors of two doubles, which every 64-bit processor has.

namespace diffcloth::contact {
namespace {
constexpr int kPack = 2;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/direction_lanes_impl.h"

namespace diffcloth::contact {
extern const DirectionLevel kPortableDirections;
const DirectionLevel kPortableDirections = kKernels;
}  // namespace diffcloth::contact
