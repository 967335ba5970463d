#pragma once

#include <cstdint>

namespace diffcloth::linalg {

/// Instructions that kernels are compiled for, and chosen by at run time.
enum class KernelLevel : std::uint8_t { kPortable, kAvx2, kAvx512 };

const char* name(KernelLevel level);

/// Whether this build and this processor have the instructions.
bool supported(KernelLevel level);

/// @throws std::invalid_argument  where they have not
void check_supported(KernelLevel level);

/// The fastest level that is supported.
KernelLevel best_level();

}  // namespace diffcloth::linalg
