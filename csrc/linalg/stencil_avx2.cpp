// Matrices of stencils with AVX2: twelve and sixteen rows are three and four vectors.
// Only CMakeLists.txt's flags for this file allow it.
#ifdef __AVX2__

#include "linalg/slot_by_halves.h"

namespace diffcloth::linalg {
namespace {
constexpr int kPack = 4;
}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/stencil_kernels_impl.h"

namespace diffcloth::linalg {
extern const AddStencil kAvx2Stencil;
const AddStencil kAvx2Stencil = add_stencil;
}  // namespace diffcloth::linalg

#endif
