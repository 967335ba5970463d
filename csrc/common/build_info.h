#pragma once

#include <string>

namespace diffcloth {

/// Configuration of the build, as text for bug reports.
struct BuildInfo {
  std::string compiler;    ///< Name and version.
  std::string build_type;  ///< CMake's: Release, Debug, ...
  std::string flags;       ///< Compiler flags.
  std::string processor;   ///< Architecture, with "native" if the build may not run elsewhere.
  std::string eigen;       ///< Version of Eigen's headers.
  std::string blas;        ///< BLAS used by CHOLMOD; "none" in a build without CHOLMOD.
};

BuildInfo build_info();

}  // namespace diffcloth
