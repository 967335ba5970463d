// The stretch of many triangles, with AVX2.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

#include "elastic/stretch_lanes_impl.h"

namespace diffcloth::elastic {
extern const StretchKernels kAvx2Stretch;
const StretchKernels kAvx2Stretch = kKernels;
}  // namespace diffcloth::elastic

#endif
