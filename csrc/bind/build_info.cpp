#include "common/build_info.h"

#include <nanobind/stl/string.h>

#include "bind/bind.h"
#include "linalg/cholesky.h"
#include "linalg/kernel_level.h"

namespace diffcloth::bind {

void build_info(nb::module_& m) {
  m.def(
      "build_info",
      [] {
        const BuildInfo info = diffcloth::build_info();
        nb::dict result;
        result["compiler"] = info.compiler;
        result["build_type"] = info.build_type;
        result["flags"] = info.flags;
        result["processor"] = info.processor;
        result["eigen"] = info.eigen;
        result["instructions"] = linalg::name(linalg::chosen_level());
        result["factorization"] = linalg::factorization_name();
        result["blas"] = info.blas;
        return result;
      },
      "What this core was built with, and the BLAS it found in this process.");
}

}  // namespace diffcloth::bind
