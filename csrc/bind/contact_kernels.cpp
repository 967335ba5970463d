#include "bind/bind.h"

namespace diffcloth::bind {

void contact_kernels(nb::module_& /*m*/) {}

}  // namespace diffcloth::bind
