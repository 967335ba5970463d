// Groups of boxes in vectors of two doubles, which every 64-bit processor has.

namespace diffcloth::contact {
namespace {
constexpr int kPack = 2;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/box_group_impl.h"

namespace diffcloth::contact {
extern const NearBoxes kPortableNearBoxes;
const NearBoxes kPortableNearBoxes = find_near_boxes;
}  // namespace diffcloth::contact
