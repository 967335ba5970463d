#include "elastic/stretch_lanes.h"

namespace diffcloth::elastic {

extern const StretchKernels kPortableStretch;
#ifdef DIFFCLOTH_X86_KERNELS
extern const StretchKernels kAvx2Stretch;
extern const StretchKernels kAvx512Stretch;
#endif

const StretchKernels& stretch_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512Stretch;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2Stretch;
#endif
  return kPortableStretch;
}

}  // namespace diffcloth::elastic
