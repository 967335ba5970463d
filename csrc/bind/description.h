#pragma once

#include "bind/named_fields.h"
#include "step/scene.h"

namespace diffcloth::bind {

/// Build the description of a scene and its options from fields by name.
///
/// @throws std::invalid_argument, nb::value_error or nb::type_error that names the field, including
/// unknown fields
step::Description describe(NamedFields fields);

}  // namespace diffcloth::bind
