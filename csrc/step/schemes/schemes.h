#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// The implementation of a scheme.
const Scheme& find_scheme(SchemeKind kind);

}  // namespace diffcloth::step
