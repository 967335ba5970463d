#include "linalg/stencil_kernels.h"

namespace diffcloth::linalg {

extern const AddStencil kPortableStencil;
#ifdef DIFFCLOTH_X86_KERNELS
extern const AddStencil kAvx2Stencil;
extern const AddStencil kAvx512Stencil;
#endif

AddStencil stencil_kernel(KernelLevel level) {
  check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == KernelLevel::kAvx512) return kAvx512Stencil;
  if (level == KernelLevel::kAvx2) return kAvx2Stencil;
#endif
  return kPortableStencil;
}

}  // namespace diffcloth::linalg
