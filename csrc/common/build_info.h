#pragma once

#include <string>

namespace diffcloth {

/// What the core was built with, in words for a person and a bug report.
struct BuildInfo {
  std::string compiler;       ///< Name and version.
  std::string build_type;     ///< CMake's: Release, Debug, ...
  std::string flags;          ///< Compiler flags.
  std::string processor;      ///< Architecture; "native" is added where it may not run elsewhere.
  std::string eigen;          ///< Version of Eigen's headers.
  std::string factorization;  ///< "cholmod 3.0.14", or "eigen".
  std::string blas;           ///< What CHOLMOD's dense kernels call; "none" without CHOLMOD.
};

BuildInfo build_info();

}  // namespace diffcloth
