#include "bind/bind.h"

namespace diffcloth::bind {

void elastic_kernels(nb::module_& /*m*/) {}

}  // namespace diffcloth::bind
