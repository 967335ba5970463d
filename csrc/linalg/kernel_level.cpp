#include "linalg/kernel_level.h"

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

KernelLevel best_level() {
  static const KernelLevel best = [] {
    if (supported(KernelLevel::kAvx512)) return KernelLevel::kAvx512;
    return supported(KernelLevel::kAvx2) ? KernelLevel::kAvx2 : KernelLevel::kPortable;
  }();
  return best;
}

}  // namespace diffcloth::linalg
