#include "contact/box_group.h"

#include <stdexcept>

namespace diffcloth::contact {

extern const NearBoxes kPortableNearBoxes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const NearBoxes kAvx2NearBoxes;
#endif

NearBoxes near_boxes(linalg::KernelLevel level) {
  if (!linalg::supported(level)) {
    throw std::invalid_argument("this processor or build has no such kernels");
  }
#ifdef DIFFCLOTH_X86_KERNELS
  if (level != linalg::KernelLevel::kPortable) return kAvx2NearBoxes;
#endif
  return kPortableNearBoxes;
}

}  // namespace diffcloth::contact
