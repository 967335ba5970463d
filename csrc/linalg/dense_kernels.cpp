#include "linalg/dense_kernels.h"

namespace diffcloth::linalg {

extern const DenseKernels kPortableKernels;
#ifdef DIFFCLOTH_X86_KERNELS
extern const DenseKernels kAvx2Kernels;
extern const DenseKernels kAvx512Kernels;
#endif

const DenseKernels& dense_kernels(KernelLevel level) {
  check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == KernelLevel::kAvx512) return kAvx512Kernels;
  if (level == KernelLevel::kAvx2) return kAvx2Kernels;
#endif
  return kPortableKernels;
}

}  // namespace diffcloth::linalg
