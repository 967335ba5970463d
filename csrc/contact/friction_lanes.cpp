#include "contact/friction_lanes.h"

namespace diffcloth::contact {

extern const FrictionKernels kPortableFrictionLanes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const FrictionKernels kAvx2FrictionLanes;
extern const FrictionKernels kAvx512FrictionLanes;
#endif

const FrictionKernels& friction_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512FrictionLanes;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2FrictionLanes;
#endif
  return kPortableFrictionLanes;
}

}  // namespace diffcloth::contact
