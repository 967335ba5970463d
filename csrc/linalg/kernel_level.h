#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace diffcloth::linalg {

/// Instructions that kernels are compiled for, and chosen by at run time.
enum class KernelLevel : std::uint8_t { kPortable, kAvx2, kAvx512 };

const char* name(KernelLevel level);

/// Whether this build and this processor have the instructions.
bool supported(KernelLevel level);

/// @throws std::invalid_argument  where they have not
void check_supported(KernelLevel level);

/// The supported levels, the fastest last.
std::vector<KernelLevel> supported_levels();

/// The supported level of this name.
///
/// @param argument  that the name was passed in, for the message
/// @throws std::invalid_argument  where no supported level has the name
KernelLevel level_named(const std::string& name, const std::string& argument);

/// The level of this process: the one that the environment variable DIFFCLOTH_INSTRUCTIONS names,
/// and the fastest that is supported where it is not set. The variable is read once.
///
/// @throws std::invalid_argument  where the variable does not name a supported level
KernelLevel chosen_level();

}  // namespace diffcloth::linalg
