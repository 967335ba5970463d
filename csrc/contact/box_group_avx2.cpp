// Groups of boxes with AVX2. Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

namespace diffcloth::contact {
namespace {
constexpr int kPack = 4;
}  // namespace
}  // namespace diffcloth::contact

#include "contact/box_group_impl.h"

namespace diffcloth::contact {
extern const NearBoxes kAvx2NearBoxes;
const NearBoxes kAvx2NearBoxes = find_near_boxes;
}  // namespace diffcloth::contact

#endif
