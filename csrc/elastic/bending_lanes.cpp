#include "elastic/bending_lanes.h"

namespace diffcloth::elastic {

extern const BendingKernels kPortableBendingLanes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const BendingKernels kAvx2BendingLanes;
extern const BendingKernels kAvx512BendingLanes;
#endif

const BendingKernels& bending_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512BendingLanes;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2BendingLanes;
#endif
  return kPortableBendingLanes;
}

}  // namespace diffcloth::elastic
