// The bending of many elements, with what every processor of the architecture has.

#include "elastic/bending_lanes_impl.h"

namespace diffcloth::elastic {
extern const BendingKernels kPortableBending;
const BendingKernels kPortableBending = kBendingKernels;
}  // namespace diffcloth::elastic
