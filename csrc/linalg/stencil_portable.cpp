// Matrices of stencils in vectors of two doubles, which every 64-bit processor has.

#include "linalg/slot_by_halves.h"

namespace diffcloth::linalg {
namespace {
constexpr int kPack = 2;
}  // namespace
}  // namespace diffcloth::linalg

#include "linalg/stencil_kernels_impl.h"

namespace diffcloth::linalg {
extern const AddStencil kPortableStencil;
const AddStencil kPortableStencil = add_stencil;
}  // namespace diffcloth::linalg
