// The stretch of many triangles, with AVX-512.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX512F__

#include "elastic/stretch_lanes_impl.h"

namespace diffcloth::elastic {
extern const StretchKernels kAvx512Stretch;
const StretchKernels kAvx512Stretch = kKernels;
}  // namespace diffcloth::elastic

#endif
