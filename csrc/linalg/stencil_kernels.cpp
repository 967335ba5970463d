#include "linalg/stencil_kernels.h"

namespace diffcloth::linalg {

extern const AddStencil kPortableStencilKernels;
#ifdef DIFFCLOTH_X86_KERNELS
extern const AddStencil kAvx2StencilKernels;
extern const AddStencil kAvx512StencilKernels;
#endif

AddStencil stencil_kernel(KernelLevel level) {
  check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == KernelLevel::kAvx512) return kAvx512StencilKernels;
  if (level == KernelLevel::kAvx2) return kAvx2StencilKernels;
#endif
  return kPortableStencilKernels;
}

}  // namespace diffcloth::linalg
