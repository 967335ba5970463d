#pragma once

#include "bind/named_fields.h"
#include "step/scene.h"

namespace diffcloth::bind {

/// A scene and its options, from fields by their names.
///
/// @throws std::invalid_argument, nb::value_error or nb::type_error that names the field, also one that
/// is not known
step::Description describe(NamedFields fields);

}  // namespace diffcloth::bind
