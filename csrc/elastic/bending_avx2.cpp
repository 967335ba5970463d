// The bending of many elements, with AVX2.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

#include "elastic/bending_lanes_impl.h"

namespace diffcloth::elastic {
extern const BendingKernels kAvx2Bending;
const BendingKernels kAvx2Bending = kBendingKernels;
}  // namespace diffcloth::elastic

#endif
