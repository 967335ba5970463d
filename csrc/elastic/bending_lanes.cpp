#include "elastic/bending_lanes.h"

namespace diffcloth::elastic {

extern const BendingKernels kPortableBending;
#ifdef DIFFCLOTH_X86_KERNELS
extern const BendingKernels kAvx2Bending;
extern const BendingKernels kAvx512Bending;
#endif

const BendingKernels& bending_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512Bending;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2Bending;
#endif
  return kPortableBending;
}

}  // namespace diffcloth::elastic
