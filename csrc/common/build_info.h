#pragma once

#include <string>

namespace diffcloth {

/// What the core was built with, in words for a person and a bug report.
struct BuildInfo {
  std::string compiler;    ///< Name and version.
  std::string build_type;  ///< CMake's: Release, Debug, ...
  std::string flags;       ///< Compiler flags.
  std::string processor;   ///< Architecture; "native" is added where it may not run elsewhere.
  std::string eigen;       ///< Version of Eigen's headers.
  std::string blas;        ///< What CHOLMOD calls; "none" in a build without CHOLMOD.
};

BuildInfo build_info();

}  // namespace diffcloth
