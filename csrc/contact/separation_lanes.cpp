#include "contact/separation_lanes.h"

namespace diffcloth::contact {

extern const SquaredDistances kPortableSeparationLanes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const SquaredDistances kAvx2SeparationLanes;
extern const SquaredDistances kAvx512SeparationLanes;
#endif

SquaredDistances squared_distances(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512SeparationLanes;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2SeparationLanes;
#endif
  return kPortableSeparationLanes;
}

}  // namespace diffcloth::contact
