#include "contact/box_group.h"

namespace diffcloth::contact {

extern const NearBoxes kPortableNearBoxes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const NearBoxes kAvx2NearBoxes;
#endif

NearBoxes near_boxes(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level != linalg::KernelLevel::kPortable) return kAvx2NearBoxes;
#endif
  return kPortableNearBoxes;
}

}  // namespace diffcloth::contact
