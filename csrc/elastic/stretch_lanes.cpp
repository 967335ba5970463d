#include "elastic/stretch_lanes.h"

namespace diffcloth::elastic {

extern const StretchKernels kPortableStretchLanes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const StretchKernels kAvx2StretchLanes;
extern const StretchKernels kAvx512StretchLanes;
#endif

const StretchKernels& stretch_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512StretchLanes;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2StretchLanes;
#endif
  return kPortableStretchLanes;
}

const StretchKernels& stretch_kernels() {
  static const StretchKernels& best = stretch_kernels(linalg::chosen_level());
  return best;
}

}  // namespace diffcloth::elastic
