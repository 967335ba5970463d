#include "contact/box_group.h"

namespace diffcloth::contact {

extern const NearBoxes kPortableBoxGroup;
#ifdef DIFFCLOTH_X86_KERNELS
extern const NearBoxes kAvx2BoxGroup;
#endif

NearBoxes near_boxes(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level != linalg::KernelLevel::kPortable) return kAvx2BoxGroup;
#endif
  return kPortableBoxGroup;
}

}  // namespace diffcloth::contact
