// Distances of two pairs at once, which every 64-bit processor can.

namespace diffcloth::contact {
namespace {
constexpr int kPack = 2;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/separation_lanes_impl.h"

namespace diffcloth::contact {
extern const SquaredDistances kPortableDistances;
const SquaredDistances kPortableDistances = find_squared_distances;
}  // namespace diffcloth::contact
