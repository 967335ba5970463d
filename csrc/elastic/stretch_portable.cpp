// The stretch of many triangles, with what every processor of the architecture has.

#include "elastic/stretch_lanes_impl.h"

namespace diffcloth::elastic {
extern const StretchKernels kPortableStretch;
const StretchKernels kPortableStretch = kKernels;
}  // namespace diffcloth::elastic
