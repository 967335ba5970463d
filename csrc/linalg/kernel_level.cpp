#include "linalg/kernel_level.h"

#include <cstdlib>
#include <stdexcept>

namespace diffcloth::linalg {

const char* name(KernelLevel level) {
  switch (level) {
    case KernelLevel::kPortable:
      return "portable";
    case KernelLevel::kAvx2:
      return "avx2";
    case KernelLevel::kAvx512:
      return "avx512";
  }
  throw std::invalid_argument("unknown kernel level");
}

bool supported(KernelLevel level) {
  if (level == KernelLevel::kPortable) return true;
#ifdef DIFFCLOTH_X86_KERNELS
  const bool avx2 = __builtin_cpu_supports("avx2") != 0 && __builtin_cpu_supports("fma") != 0;
  if (level == KernelLevel::kAvx2) return avx2;
  return avx2 && __builtin_cpu_supports("avx512f") != 0 &&
         __builtin_cpu_supports("avx512vl") != 0 && __builtin_cpu_supports("avx512dq") != 0;
#else
  return false;
#endif
}

void check_supported(KernelLevel level) {
  if (!supported(level)) {
    throw std::invalid_argument("this processor or build has no such kernels");
  }
}

std::vector<KernelLevel> supported_levels() {
  using enum KernelLevel;
  std::vector<KernelLevel> levels;
  for (const KernelLevel level : {kPortable, kAvx2, kAvx512}) {
    if (supported(level)) levels.push_back(level);
  }
  return levels;
}

KernelLevel level_named(const std::string& name, const std::string& argument) {
  std::string names;
  for (const KernelLevel level : supported_levels()) {
    if (name == linalg::name(level)) return level;
    names.append(names.empty() ? "" : ", ").append(linalg::name(level));
  }
  throw std::invalid_argument(argument + " must be one of " + names +
                              ", which this build and this processor have, got '" + name + "'");
}

KernelLevel chosen_level() {
  static const KernelLevel chosen = [] {
    const char* const variable = "DIFFCLOTH_INSTRUCTIONS";
    const char* const named = std::getenv(variable);
    return named == nullptr ? supported_levels().back() : level_named(named, variable);
  }();
  return chosen;
}

}  // namespace diffcloth::linalg
