#include "common/build_info.h"

#include <Eigen/Core>

#ifdef DIFFCLOTH_HAS_CHOLMOD
#include <dlfcn.h>
#endif

namespace diffcloth {
namespace {

#ifdef DIFFCLOTH_HAS_CHOLMOD

/// Library that provides dgemm in this process, with OpenBLAS' own description. The loader chooses it at
/// run time: a system alternative, or a copy that another package loaded before.
std::string blas() {
  void* const dgemm = dlsym(RTLD_DEFAULT, "dgemm_");
  Dl_info library{};
  if (dgemm == nullptr || dladdr(dgemm, &library) == 0) return "unknown";
  std::string result = library.dli_fname;
  using Describe = char* (*)();
  const auto describe = reinterpret_cast<Describe>(dlsym(RTLD_DEFAULT, "openblas_get_config"));
  if (describe != nullptr) result.append(" (").append(describe()).append(")");
  return result;
}

#else

const char* blas() { return "none"; }

#endif

}  // namespace

BuildInfo build_info() {
  return {.compiler = DIFFCLOTH_COMPILER,
          .build_type = DIFFCLOTH_BUILD_TYPE,
          .flags = DIFFCLOTH_FLAGS,
          .processor = DIFFCLOTH_PROCESSOR,
          .eigen = std::to_string(EIGEN_WORLD_VERSION) + "." + std::to_string(EIGEN_MAJOR_VERSION) +
                   "." + std::to_string(EIGEN_MINOR_VERSION),
          .blas = blas()};
}

}  // namespace diffcloth
