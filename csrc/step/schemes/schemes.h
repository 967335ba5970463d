#pragma once

#include "step/scheme.h"

namespace diffcloth::step {

/// The implementation of a scheme with an integrator.
const Scheme& find_scheme(SchemeKind kind, Integrator integrator);

}  // namespace diffcloth::step
