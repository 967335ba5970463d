#include "contact/separation_lanes.h"

namespace diffcloth::contact {

extern const SquaredDistances kPortableDistances;
#ifdef DIFFCLOTH_X86_KERNELS
extern const SquaredDistances kAvx2Distances;
extern const SquaredDistances kAvx512Distances;
#endif

SquaredDistances squared_distances(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512Distances;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2Distances;
#endif
  return kPortableDistances;
}

}  // namespace diffcloth::contact
