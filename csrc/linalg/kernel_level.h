#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace diffcloth::linalg {

/// Instruction set of kernels, selected at run time.
enum class KernelLevel : std::uint8_t { kPortable, kAvx2, kAvx512 };

const char* name(KernelLevel level);

/// True if this build and this processor support the instructions.
bool supported(KernelLevel level);

/// @throws std::invalid_argument  if they do not
void check_supported(KernelLevel level);

/// The supported levels, the fastest last.
std::vector<KernelLevel> supported_levels();

/// Supported level with this name.
///
/// @param argument  name of the caller's argument, for the message
/// @throws std::invalid_argument  if no supported level has the name
KernelLevel level_named(const std::string& name, const std::string& argument);

/// Level of this process: from the environment variable DIFFCLOTH_INSTRUCTIONS, or the fastest supported
/// level if it is not set. The variable is read once.
///
/// @throws std::invalid_argument  if the variable does not name a supported level
KernelLevel chosen_level();

}  // namespace diffcloth::linalg
