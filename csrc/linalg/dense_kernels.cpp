#include "linalg/dense_kernels.h"

namespace diffcloth::linalg {

extern const DenseKernels kPortableDenseKernels;
#ifdef DIFFCLOTH_X86_KERNELS
extern const DenseKernels kAvx2DenseKernels;
extern const DenseKernels kAvx512DenseKernels;
#endif

const DenseKernels& dense_kernels(KernelLevel level) {
  check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == KernelLevel::kAvx512) return kAvx512DenseKernels;
  if (level == KernelLevel::kAvx2) return kAvx2DenseKernels;
#endif
  return kPortableDenseKernels;
}

}  // namespace diffcloth::linalg
