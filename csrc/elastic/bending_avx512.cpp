// The bending of many elements, with AVX-512.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX512F__

#include "elastic/bending_lanes_impl.h"

namespace diffcloth::elastic {
extern const BendingKernels kAvx512Bending;
const BendingKernels kAvx512Bending = kBendingKernels;
}  // namespace diffcloth::elastic

#endif
